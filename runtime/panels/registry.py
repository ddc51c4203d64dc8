"""Functions that open the configured panels, and offscreen panels for replay and tests."""

from __future__ import annotations

from typing import TYPE_CHECKING

from runtime.browser.link import BrowserLink
from runtime.clock import Clock
from runtime.config import OutputSettings, PanelSettings
from runtime.optics.stack import PanelStack
from runtime.panels.base import PanelSink
from runtime.records import PanelFrame, PresentReport

if TYPE_CHECKING:
    import moderngl


class OffscreenPanels(PanelSink):
    """Panels without a screen, which accept frames but do not draw them."""

    name = "offscreen"

    def __init__(self, clock: Clock) -> None:
        self._clock = clock

    def present(self, frame: PanelFrame, *, unchanged: bool = False) -> PresentReport:
        return PresentReport(frame.number, self._clock.now_ns(), 0.0)

    def close(self) -> None:
        """Do nothing, because nothing was opened."""


class BrowserPanels(PanelSink):
    """Panels in a web page, which aligns and draws them at its own rate."""

    name = "browser"

    def __init__(self, link: BrowserLink, clock: Clock) -> None:
        self._link, self._clock = link, clock

    def present(self, frame: PanelFrame, *, unchanged: bool = False) -> PresentReport:
        self._link.frame = frame
        return PresentReport(frame.number, self._clock.now_ns(), 0.0)

    def close(self) -> None:
        self._link.frame = None


def panel_settings(settings: OutputSettings, count: int) -> tuple[PanelSettings, ...]:
    """Return the settings of each panel, or defaults if none are configured."""
    return settings.panels or tuple(PanelSettings() for _ in range(count))


def open_panels(settings: OutputSettings, stack: PanelStack, clock: Clock, context: moderngl.Context) -> PanelSink:
    """Open the output of `[output]`. After each of its calls `context` is current again.

    Raises InputError for unsuitable settings, and PanelLost if a monitor is missing, which may be temporary.
    """
    if settings.kind != "offscreen":
        from runtime.panels.window import WindowPanels

        return WindowPanels(panel_settings(settings, stack.count), stack, clock, context)
    return OffscreenPanels(clock)
