"""Whether monitors' modes fit the stack: phases must reach the panel's pixels as they are, at one rate."""

from __future__ import annotations

from collections.abc import Sequence

from runtime.config import PanelSettings
from runtime.errors import PanelLost
from runtime.panels.geometry import panel_size_px
from runtime.panels.monitors import Monitor

REFRESH_TOLERANCE_HZ = 0.05  # 59.94 and 60 Hz drift apart by a frame in 17 s


def check_mode(
    number: int, panel: PanelSettings, monitor: Monitor, *, width_px: int, height_px: int, allow_rescaling: bool
) -> None:
    """Raise PanelLost where a monitor's mode has other pixels than the stack, unless rescaling is allowed.

    A phase between two pixels' phases is none that was solved for: a rescaled layer shows neither eye its picture.
    """
    columns, rows = panel_size_px(
        screen_width_px=monitor.width_px, screen_height_px=monitor.height_px, rotation_deg=panel.rotation_deg
    )
    if (columns, rows) != (width_px, height_px) and not allow_rescaling:
        raise PanelLost(
            f"panel {number}: {monitor.connector} shows {columns}x{rows}, the stack is {width_px}x{height_px}: phases "
            "would be rescaled. Set its mode or stack.width_px and height_px, or output.allow_rescaling = true"
        )


def refresh_difference(monitors: Sequence[Monitor]) -> str:
    """One line where the panels' monitors refresh at different rates, else an empty text; unknown rates (0) pass."""
    known = [monitor for monitor in monitors if monitor.refresh_hz > 0]
    rates = [monitor.refresh_hz for monitor in known]
    if not rates or max(rates) - min(rates) <= REFRESH_TOLERANCE_HZ:
        return ""
    each = ", ".join(f"{monitor.connector} {monitor.refresh_hz:.2f} Hz" for monitor in known)
    return f"the panels refresh at different rates ({each}): a frame is not on all of them at once"
