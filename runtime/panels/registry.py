"""Open the configured output to the panels, or an offscreen output for replays and tests."""

from __future__ import annotations

from typing import TYPE_CHECKING

from runtime.clock import Clock
from runtime.config import OutputSettings, PanelSettings
from runtime.optics.stack import PanelStack
from runtime.panels.base import PanelSink
from runtime.records import PanelFrame, PresentReport

if TYPE_CHECKING:
    import moderngl


class OffscreenPanels(PanelSink):
    """Output with no screen, which accepts frames but does not draw them.
    A web page, for example, draws them.
    """

    def __init__(self, clock: Clock, *, name: str = "offscreen") -> None:
        self._clock, self.name = clock, name

    def present(self, frame: PanelFrame, *, unchanged: bool = False, due_ns: int | None = None) -> PresentReport:
        return PresentReport(frame.number, self._clock.now_ns(), 0.0)

    def close(self) -> None:
        """Do nothing, because no windows or contexts are open."""


def panel_settings(settings: OutputSettings, count: int) -> tuple[PanelSettings, ...]:
    """Return each panel's settings, or default settings for `count` panels if none are configured."""
    return settings.panels or tuple(PanelSettings() for _ in range(count))


def open_panels(settings: OutputSettings, stack: PanelStack, clock: Clock, context: moderngl.Context) -> PanelSink:
    """Open the output that `[output]` describes. After each call, `context` is current again. Raises
    InputError if settings cannot be used, and PanelLost for a monitor, which may be temporary.
    """
    if settings.kind != "offscreen":
        from runtime.panels.window import WindowPanels

        layer_px = stack.width_px, stack.height_px
        return WindowPanels(panel_settings(settings, stack.count), layer_px, clock, context)
    return OffscreenPanels(clock)
