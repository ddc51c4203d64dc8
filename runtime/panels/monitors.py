"""Which monitor is which panel: by EDID serial, else connector, else explicit index. Never by a guess."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from runtime.config import PanelSettings
from runtime.errors import InputError, PanelLost
from runtime.panels.geometry import panel_size_px

ASPECT_TOLERANCE = 0.01


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

    def __str__(self) -> str:
        serial = f", serial {self.serial}" if self.serial else ""
        model = f" {self.model}" if self.model else ""
        size = f"{self.width_px}x{self.height_px}+{self.x_px}+{self.y_px}"
        return f"{self.connector}{model} ({size}{serial})"


def in_order(monitors: Sequence[Monitor]) -> tuple[Monitor, ...]:
    """The order that an index counts in: from left to right, then from top to bottom."""
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
    if panel.index >= 0:
        wanted.append(f"index {panel.index}")
        left = [monitor for monitor in left if monitors[panel.index : panel.index + 1] == (monitor,)]
    if not wanted:
        raise InputError(
            "output", f"panels.{number}", "names no monitor: set edid_serial or connector (`phasestack identify`)"
        )
    if len(left) == 1:
        return left[0]
    there = "; ".join(str(monitor) for monitor in monitors) or "none"
    problem = "no monitor" if not left else f"{len(left)} monitors"
    raise PanelLost(f"panel {number}: {problem} with {' and '.join(wanted)} (there are: {there})")


def check_shape(number: int, panel: PanelSettings, monitor: Monitor, *, width_px: int, height_px: int) -> None:
    """Raises PanelLost where a monitor's mode has another shape than the panel: its picture would be distorted."""
    columns, rows = panel_size_px(
        screen_width_px=monitor.width_px, screen_height_px=monitor.height_px, rotation_deg=panel.rotation_deg
    )
    if abs(columns * height_px / (rows * width_px) - 1.0) > ASPECT_TOLERANCE:
        raise PanelLost(
            f"panel {number}: {monitor.connector} shows {columns}x{rows} (mounted at {panel.rotation_deg} degrees), "
            f"the stack is {width_px}x{height_px}: set its mode or rotation_deg"
        )
