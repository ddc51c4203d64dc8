"""Which monitor is which panel: by EDID serial, else connector, never by a guess; and whether
their modes fit the stack: phases must reach the panel's pixels as they are, at one rate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from runtime.config import PanelSettings
from runtime.errors import InputError, PanelLost
from runtime.panels.geometry import panel_size_px

REFRESH_TOLERANCE_HZ = 0.05  # 59.94 and 60 Hz drift apart by a frame in 17 s


class Rectangle(NamedTuple):
    """A part of the X screen, pixels, from its top left corner."""

    x_px: int
    y_px: int
    width_px: int
    height_px: int

    def __str__(self) -> str:
        return f"{self.width_px}x{self.height_px}+{self.x_px}+{self.y_px}"


@dataclass(frozen=True, slots=True)
class Monitor:
    """One monitor of the X screen, active."""

    connector: str
    serial: str  # EDID's; empty where it has none
    model: str
    x_px: int  # of its top left corner on the X screen
    y_px: int
    width_px: int
    height_px: int
    refresh_hz: float  # 0: unknown

    @property
    def place(self) -> Rectangle:
        """The part of the X screen that it shows."""
        return Rectangle(self.x_px, self.y_px, self.width_px, self.height_px)

    @property
    def setting(self) -> str:
        """The settings in `[[output.panels]]` that identify it."""
        return f'edid_serial = "{self.serial}"' if self.serial else f'connector = "{self.connector}"'

    def __str__(self) -> str:
        serial = f", serial {self.serial}" if self.serial else ""
        model = f" {self.model}" if self.model else ""
        return f"{self.connector}{model} ({self.place}{serial})"


def in_order(monitors: Sequence[Monitor]) -> tuple[Monitor, ...]:
    """Monitors sorted from left to right, then from top to bottom."""
    return tuple(sorted(monitors, key=lambda monitor: (monitor.x_px, monitor.y_px, monitor.connector)))


def bind(panels: Sequence[PanelSettings], monitors: Sequence[Monitor]) -> tuple[Monitor, ...]:
    """The monitor of each panel, rear to front.

    What a panel names first decides: a serial that is not there is not made up for by a connector. What it
    names beyond that must agree, and tells apart what is alike otherwise.

    Raises InputError for a panel that names nothing (and with it no wait can help), PanelLost where a panel's
    monitor is missing, ambiguous, or another panel's too; the text names panel, criterion and what is there.
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
    wanted: list[str] = []
    left = list(monitors)
    if panel.edid_serial:
        wanted.append(f"EDID serial {panel.edid_serial}")
        left = [monitor for monitor in left if monitor.serial == panel.edid_serial]
    if panel.connector:
        wanted.append(f"connector {panel.connector}")
        left = [monitor for monitor in left if monitor.connector == panel.connector]
    if not wanted:
        raise InputError(
            "output", f"panels.{number}", "names no monitor: set edid_serial or connector (`phasestack identify`)"
        )
    if len(left) == 1:
        return left[0]
    there = "; ".join(str(monitor) for monitor in monitors) or "none"
    problem = "no monitor" if not left else f"{len(left)} monitors"
    raise PanelLost(f"panel {number}: {problem} with {' and '.join(wanted)} (there are: {there})")


def check_modes(panels: Sequence[PanelSettings], monitors: Sequence[Monitor], *, width_px: int, height_px: int) -> None:
    """Raise PanelLost where a monitor's mode has other pixels than the stack.

    A phase between two pixels' phases is none that was solved for: a rescaled layer shows neither eye its picture.
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
    """One line if the panels' monitors refresh at different rates, else empty; rate 0 is unknown."""
    known = [monitor for monitor in monitors if monitor.refresh_hz > 0]
    rates = [monitor.refresh_hz for monitor in known]
    if not rates or max(rates) - min(rates) <= REFRESH_TOLERANCE_HZ:
        return ""
    each = ", ".join(f"{monitor.connector} {monitor.refresh_hz:.2f} Hz" for monitor in known)
    return f"the panels refresh at different rates ({each}): a frame is not on all of them at once"
