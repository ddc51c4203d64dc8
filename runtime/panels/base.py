"""Where layers go: one interface for windows and for offscreen panels."""

from __future__ import annotations

from abc import ABC, abstractmethod

from runtime.records import LayerFrame, PresentReport


class PanelSink(ABC):
    """All panels of the stack. One frame is on all of them or on none."""

    name: str

    @abstractmethod
    def present(self, frame: LayerFrame, *, unchanged: bool = False) -> PresentReport:
        """Show a frame on every panel.

        unchanged: the caller vouches that the layers are those of the frame before: panels that still show them
        upload and draw nothing, so that a picture without a viewer costs next to nothing.
        Raises PanelLost: rebuilt by a later call, the loop goes on.
        """

    @abstractmethod
    def close(self) -> None:
        """Release windows and contexts. May be called twice; never raises."""
