"""Where layers go: one interface for windows and for offscreen panels."""

from __future__ import annotations

from abc import ABC, abstractmethod

from runtime.records import LayerFrame, PresentReport


class PanelSink(ABC):
    """All panels of the stack. One frame is on all of them or on none."""

    name: str

    @abstractmethod
    def present(self, frame: LayerFrame) -> PresentReport:
        """Show a frame on every panel. Raises PanelLost: rebuilt in the background, the loop goes on."""

    @abstractmethod
    def close(self) -> None:
        """Release windows and contexts. May be called twice; never raises."""
