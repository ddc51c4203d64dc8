"""Assignment of monitors to panels by EDID serial or connector, with checks of their modes and rates.

Monitors are never guessed and pictures never rescaled: phases must reach the panels unchanged, at one refresh rate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from runtime.config import PanelSettings
from runtime.errors import InputError, PanelLost
from runtime.panels.geometry import panel_size_px

REFRESH_TOLERANCE_HZ = 0.05  # 59.94 and 60 Hz drift apart by a frame in 17 s


class Rectangle(NamedTuple):
    """A region of the X screen, pixels from its top left corner."""

    x_px: int
    y_px: int
    width_px: int
    height_px: int

    def __str__(self) -> str:
        return f"{self.width_px}x{self.height_px}+{self.x_px}+{self.y_px}"


@dataclass(frozen=True, slots=True)
class Monitor:
    """One active monitor of the X screen."""

    connector: str
    serial: str  # from the EDID; empty if it has none
    model: str
    x_px: int  # position of its top left corner on the X screen
    y_px: int
    width_px: int
    height_px: int
    refresh_hz: float  # 0: unknown

    @property
    def place(self) -> Rectangle:
        """Return the region of the X screen that the monitor shows."""
        return Rectangle(self.x_px, self.y_px, self.width_px, self.height_px)

    @property
    def setting(self) -> str:
        """Return the line for `[[output.panels]]` that identifies this monitor."""
        return f'edid_serial = "{self.serial}"' if self.serial else f'connector = "{self.connector}"'

    def __str__(self) -> str:
        serial = f", serial {self.serial}" if self.serial else ""
        model = f" {self.model}" if self.model else ""
        return f"{self.connector}{model} ({self.place}{serial})"


def in_order(monitors: Sequence[Monitor]) -> tuple[Monitor, ...]:
    """Sort monitors from left to right, then from top to bottom."""
    return tuple(sorted(monitors, key=lambda monitor: (monitor.x_px, monitor.y_px, monitor.connector)))


def bind(panels: Sequence[PanelSettings], monitors: Sequence[Monitor]) -> tuple[Monitor, ...]:
    """Find the monitor of each panel, rear to front.

    A monitor must match both serial and connector if a panel gives both. Monitors with equal serials are distinguished
    by their connectors.

    Raises InputError if a panel has neither, since waiting can't help; PanelLost if a panel's monitor is missing,
    ambiguous or already bound to another panel. The message names the panel, the criteria and the monitors found.
    """
    ordered = in_order(monitors)
    bound: list[Monitor] = []
    for number, panel in enumerate(panels):
        monitor = _find(number, panel, ordered)
        if monitor in bound:
            raise PanelLost(f"panels {bound.index(monitor)} and {number} are bound to the same monitor {monitor}")
        bound.append(monitor)
    return tuple(bound)


def _find(number: int, panel: PanelSettings, monitors: tuple[Monitor, ...]) -> Monitor:
    criteria: list[str] = []
    matches = list(monitors)
    if panel.edid_serial:
        criteria.append(f"EDID serial {panel.edid_serial}")
        matches = [monitor for monitor in matches if monitor.serial == panel.edid_serial]
    if panel.connector:
        criteria.append(f"connector {panel.connector}")
        matches = [monitor for monitor in matches if monitor.connector == panel.connector]
    if not criteria:
        raise InputError(
            "output",
            f"panels.{number}",
            "names no monitor: set edid_serial or connector (see `phasestack identify`)",
        )
    if len(matches) == 1:
        return matches[0]
    connected = "; ".join(str(monitor) for monitor in monitors) or "none"
    problem = "no monitor" if not matches else f"{len(matches)} monitors"
    raise PanelLost(f"panel {number}: {problem} with {' and '.join(criteria)} (connected: {connected})")


def check_modes(panels: Sequence[PanelSettings], monitors: Sequence[Monitor], *, width_px: int, height_px: int) -> None:
    """Raise PanelLost if a monitor's resolution differs from the stack's.

    Rescaling would mix the phases of neighbouring pixels and destroy both eyes' pictures.
    """
    for number, (panel, monitor) in enumerate(zip(panels, monitors, strict=True)):
        columns, rows = panel_size_px(
            screen_width_px=monitor.width_px, screen_height_px=monitor.height_px, rotation_deg=panel.rotation_deg
        )
        if (columns, rows) != (width_px, height_px):
            raise PanelLost(
                f"panel {number}: {monitor.connector} shows {columns}x{rows} (mounted at {panel.rotation_deg} degrees),"
                f" the stack is {width_px}x{height_px}: phases would be rescaled. Set its mode or rotation_deg, or "
                "stack.width_px and height_px"
            )


def refresh_difference(monitors: Sequence[Monitor]) -> str:
    """Warn in one line if monitors' refresh rates differ, else return an empty string. 0: unknown rate."""
    known = [monitor for monitor in monitors if monitor.refresh_hz > 0]
    rates = [monitor.refresh_hz for monitor in known]
    if not rates or max(rates) - min(rates) <= REFRESH_TOLERANCE_HZ:
        return ""
    each = ", ".join(f"{monitor.connector} {monitor.refresh_hz:.2f} Hz" for monitor in known)
    return f"the panels refresh at different rates ({each}), so their frames do not change at the same time"
