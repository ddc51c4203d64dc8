"""Which panels the settings ask for."""

from __future__ import annotations

from typing import TYPE_CHECKING

from runtime.clock import Clock
from runtime.config import OutputSettings, PanelSettings
from runtime.optics.stack import PanelStack
from runtime.panels.base import PanelSink

if TYPE_CHECKING:
    import moderngl


def panel_settings(settings: OutputSettings, count: int) -> tuple[PanelSettings, ...]:
    """One table a panel: as configured, or defaults where none is."""
    return settings.panels or tuple(PanelSettings() for _ in range(count))


def open_panels(settings: OutputSettings, stack: PanelStack, clock: Clock, context: moderngl.Context) -> PanelSink:
    """The sink that `[output]` asks for; `context` is current again whenever one of its methods has returned.

    Raises InputError (settings that don't fit), PanelLost (a monitor is not there yet: wait and retry).
    """
    if settings.kind != "offscreen":
        from runtime.panels.window import WindowPanels

        return WindowPanels(panel_settings(settings, stack.count), stack, clock, context)
    from runtime.panels.offscreen import OffscreenPanels

    return OffscreenPanels(clock)
