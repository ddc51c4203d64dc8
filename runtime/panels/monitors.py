"""Assign a monitor to each panel by EDID serial number or connector, and check the monitors' modes.

Monitors are never guessed. Pictures are never rescaled, because the phases must reach the panels unchanged.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from runtime.config import PanelSettings
from runtime.errors import InputError, PanelLost
from runtime.panels.geometry import panel_size_px

REFRESH_TOLERANCE_HZ = 0.05  # two panels at 59.94 Hz and 60 Hz would drift apart by a frame every 17 s


class Rectangle(NamedTuple):
    """A region of the X screen, in pixels from the screen's top left corner."""

    x_px: int
    y_px: int
    width_px: int
    height_px: int

    def __str__(self) -> str:
        return f"{self.width_px}x{self.height_px}+{self.x_px}+{self.y_px}"

    def overlaps(self, other: Rectangle) -> bool:
        """Return True if the two regions have pixels in common."""
        across = min(self.x_px + self.width_px, other.x_px + other.width_px) - max(self.x_px, other.x_px)
        down = min(self.y_px + self.height_px, other.y_px + other.height_px) - max(self.y_px, other.y_px)
        return across > 0 and down > 0


@dataclass(frozen=True, slots=True)
class Monitor:
    """An active monitor on the X screen."""

    connector: str
    serial: str  # serial number in the EDID; empty if unknown
    model: str  # manufacturer and name in the EDID; empty if unknown
    x_px: int  # the top left corner's column on the X screen
    y_px: int  # the top left corner's row on the X screen
    width_px: int
    height_px: int
    refresh_hz: float  # 0 if unknown
    has_gamma: bool = False  # True if the X server changes the grey levels

    @property
    def place(self) -> Rectangle:
        """The region of the X screen shown on this monitor."""
        return Rectangle(self.x_px, self.y_px, self.width_px, self.height_px)

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height."""
        return self.width_px, self.height_px

    def selection(self, monitors: Sequence[Monitor]) -> dict[str, Any]:
        """Return the setting in `[[output.panels]]` that selects this monitor: serial number or connector."""
        is_unique = [monitor.serial for monitor in monitors].count(self.serial) == 1
        return {"edid_serial": self.serial} if self.serial and is_unique else {"connector": self.connector}

    def setting(self, monitors: Sequence[Monitor]) -> str:
        """Return the `selection` as a line of a configuration."""
        ((name, value),) = self.selection(monitors).items()
        return f"{name} = {json.dumps(value, ensure_ascii=False)}"  # a string of JSON is also one of TOML

    def __str__(self) -> str:
        serial = f", serial {self.serial}" if self.serial else ""
        model = f" {self.model}" if self.model else ""
        return f"{self.connector}{model} ({self.place}{serial})"


def in_order(monitors: Sequence[Monitor]) -> tuple[Monitor, ...]:
    """Return the monitors sorted from left to right, then from top to bottom."""
    return tuple(sorted(monitors, key=lambda monitor: (monitor.x_px, monitor.y_px, monitor.connector)))


def bind(panels: Sequence[PanelSettings], monitors: Sequence[Monitor]) -> tuple[Monitor, ...]:
    """Find each panel's monitor by serial number, by connector, or by both if several have the same
    number. Raises InputError if a panel's settings give neither, and PanelLost if a monitor is missing, ambiguous,
    already assigned or mirrored on another panel's, which may be temporary.
    """
    ordered = in_order(monitors)
    bound: list[Monitor] = []
    for number, panel in enumerate(panels):
        monitor = _find(number, panel, ordered)
        if monitor in bound:
            raise PanelLost(f"panels {bound.index(monitor)} and {number} cannot both use the monitor {monitor}")
        for other, earlier in enumerate(bound):
            if monitor.place.overlaps(earlier.place):
                raise PanelLost(
                    f"panels {other} and {number} would show the same pixels, because {earlier} and {monitor} overlap; "
                    f"turn off mirroring, for example with `xrandr --output {monitor.connector} --right-of "
                    f"{earlier.connector}`"
                )
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
            "does not select a monitor; set edid_serial or connector to the value shown by `phasestack identify`",
        )
    if len(matches) == 1:
        return matches[0]
    connected = "; ".join(str(monitor) for monitor in monitors) or "none"
    problem = "no monitor has" if not matches else f"{len(matches)} monitors have"
    raise PanelLost(f"panel {number}: {problem} {' and '.join(criteria)}; connected monitors: {connected}")


def check_modes(panels: Sequence[PanelSettings], monitors: Sequence[Monitor], *, width_px: int, height_px: int) -> None:
    """Raise PanelLost if a monitor's resolution is not the stack's: rescaling would mix phases."""
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


def gamma_warning(monitors: Sequence[Monitor]) -> str:
    """Return a one-line warning if the X server changes the panels' grey levels, or an empty string."""
    changed = [monitor.connector for monitor in monitors if monitor.has_gamma]
    if not changed:
        return ""
    return (
        f"the X server changes the grey levels of {', '.join(changed)} (gamma, brightness or a night light), so the "
        f"panels' curves are wrong; turn it off with `xrandr --output {changed[0]} --gamma 1:1:1 --brightness 1`"
    )


def refresh_difference(monitors: Sequence[Monitor]) -> str:
    """Return a one-line warning if the known refresh rates differ, or an empty string."""
    known = [monitor for monitor in monitors if monitor.refresh_hz]
    rates = [monitor.refresh_hz for monitor in known]
    if not rates or max(rates) - min(rates) <= REFRESH_TOLERANCE_HZ:
        return ""
    each = ", ".join(f"{monitor.connector} {monitor.refresh_hz:.2f} Hz" for monitor in known)
    return f"the panels have different refresh rates ({each}), so they do not change frames at the same time"
