"""Assignment of monitors to panels by EDID serial number or connector, and checks of their modes.

A monitor is never guessed and a picture never rescaled, because phases must reach the panels unchanged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from runtime.config import PanelSettings
from runtime.errors import InputError, PanelLost
from runtime.panels.geometry import panel_size_px

REFRESH_TOLERANCE_HZ = 0.05  # 59.94 and 60 Hz would drift apart by a frame in 17 s


class Rectangle(NamedTuple):
    """Region of the X screen, in pixels from its top left corner."""

    x_px: int
    y_px: int
    width_px: int
    height_px: int

    def __str__(self) -> str:
        return f"{self.width_px}x{self.height_px}+{self.x_px}+{self.y_px}"


@dataclass(frozen=True, slots=True)
class Monitor:
    """Active monitor of the X screen."""

    connector: str
    serial: str  # from the EDID; empty if unknown
    model: str
    x_px: int  # top left corner on the X screen
    y_px: int
    width_px: int
    height_px: int
    refresh_hz: float  # 0: unknown

    @property
    def place(self) -> Rectangle:
        """Region of the X screen that the monitor shows."""
        return Rectangle(self.x_px, self.y_px, self.width_px, self.height_px)

    @property
    def setting(self) -> str:
        """Line for `[[output.panels]]` that identifies this monitor."""
        return f'edid_serial = "{self.serial}"' if self.serial else f'connector = "{self.connector}"'

    def __str__(self) -> str:
        serial = f", serial {self.serial}" if self.serial else ""
        model = f" {self.model}" if self.model else ""
        return f"{self.connector}{model} ({self.place}{serial})"


def in_order(monitors: Sequence[Monitor]) -> tuple[Monitor, ...]:
    """Sort monitors from left to right, then from top to bottom."""
    return tuple(sorted(monitors, key=lambda monitor: (monitor.x_px, monitor.y_px, monitor.connector)))


def bind(panels: Sequence[PanelSettings], monitors: Sequence[Monitor]) -> tuple[Monitor, ...]:
    """Return the monitor of each panel, rear to front.

    If a panel gives both serial number and connector, its monitor must match both. This distinguishes monitors with
    equal serial numbers.

    Raises InputError if a panel gives neither, and PanelLost if a monitor is missing, ambiguous or already assigned,
    which may be temporary. The message names the panel, the criteria and the connected monitors.
    """
    ordered = in_order(monitors)
    bound: list[Monitor] = []
    for number, panel in enumerate(panels):
        monitor = _find(number, panel, ordered)
        if monitor in bound:
            raise PanelLost(f"panels {bound.index(monitor)} and {number} cannot both use the monitor {monitor}")
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
            "does not name a monitor; set edid_serial or connector as shown by `phasestack identify`",
        )
    if len(matches) == 1:
        return matches[0]
    connected = "; ".join(str(monitor) for monitor in monitors) or "none"
    problem = "no monitor has" if not matches else f"{len(matches)} monitors have"
    raise PanelLost(f"panel {number}: {problem} {' and '.join(criteria)}; connected monitors: {connected}")


def check_modes(panels: Sequence[PanelSettings], monitors: Sequence[Monitor], *, width_px: int, height_px: int) -> None:
    """Raise PanelLost if the resolution of a monitor differs from that of the stack.

    Rescaling would mix the phases of neighbouring pixels and destroy the pictures for both eyes.
    """
    for number, (panel, monitor) in enumerate(zip(panels, monitors, strict=True)):
        columns, rows = panel_size_px(
            screen_width_px=monitor.width_px, screen_height_px=monitor.height_px, rotation_deg=panel.rotation_deg
        )
        if (columns, rows) != (width_px, height_px):
            raise PanelLost(
                f"panel {number}: {monitor.connector} shows {columns}x{rows} at {panel.rotation_deg} degrees,"
                f" but the stack has {width_px}x{height_px} pixels; change the mode, rotation_deg, or "
                "stack.width_px and height_px"
            )


def refresh_difference(monitors: Sequence[Monitor]) -> str:
    """Return a warning in one line if known refresh rates differ, otherwise an empty string."""
    known = [monitor for monitor in monitors if monitor.refresh_hz > 0]
    rates = [monitor.refresh_hz for monitor in known]
    if not rates or max(rates) - min(rates) <= REFRESH_TOLERANCE_HZ:
        return ""
    each = ", ".join(f"{monitor.connector} {monitor.refresh_hz:.2f} Hz" for monitor in known)
    return f"the panels have different refresh rates ({each}), so their frames do not change at the same time"
