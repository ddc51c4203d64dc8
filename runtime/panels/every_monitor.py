"""Windows on all monitors, each with its identity card: for who has bound no panels yet."""

from __future__ import annotations

from runtime.clock import MonotonicClock
from runtime.config import PanelSettings
from runtime.optics.stack import PanelStack
from runtime.panels.card import identity_card
from runtime.panels.display import connected_monitors
from runtime.panels.monitors import Monitor
from runtime.panels.window import WindowPanels
from runtime.records import U8
from runtime.support.gl import offscreen_context


def every_monitor() -> tuple[WindowPanels, list[U8], tuple[Monitor, ...]]:
    """Windows on all monitors whatever they are, their cards, and what they are called. Raises PanelLost."""
    monitors = connected_monitors()
    width, height = max(m.width_px for m in monitors), max(m.height_px for m in monitors)
    bound = tuple(PanelSettings(connector=monitor.connector) for monitor in monitors)
    # Only for this picture: monitors of any shape, each filled.
    stack = PanelStack(1.0, 1.0, tuple(0.01 * index for index in range(len(monitors))), width, height)
    panels = WindowPanels(bound, stack, MonotonicClock(), offscreen_context(), any_shape=True)
    cards = []
    for monitor in monitors:
        lines = [monitor.model or "(no name in its EDID)", f"{monitor.width_px} x {monitor.height_px}",
                 "in the configuration:", "[[output.panels]]", monitor.setting]  # fmt: skip
        cards.append(identity_card(width, height, title=monitor.connector, lines=lines))
    return panels, cards, monitors
