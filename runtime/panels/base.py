"""The interface of panel sinks: windows, offscreen, browser."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

from runtime.records import PanelFrame, PresentReport


class PanelSink(ABC):
    """A sink for all panels of the stack; a frame is shown on all of them or on none."""

    name: str
    contexts_lost = 0  # GL contexts lost since the start; after a GPU reset every other context is lost as well

    @property
    def period_ns(self) -> int | None:
        """Interval between vertical blanks of the monitor that sets the pace; None if unknown."""
        return None

    @property
    def window_handles(self) -> list[Any]:
        """GLFW handles of the open windows, for their keys."""
        return []

    @abstractmethod
    def present(self, frame: PanelFrame, *, unchanged: bool = False) -> PresentReport:
        """Show a frame on every panel: its solution aligned, then mixed with its flat picture.

        The frame's arrays must not change until another frame has been presented; a sink may read them until then.
        unchanged: the caller guarantees that the frame shows the same picture as the previous one. Panels that still
        show it skip upload, drawing and swap, so a picture without a viewer costs almost nothing.
        Raises PanelLost; a later call rebuilds the panels.
        """

    @abstractmethod
    def close(self) -> None:
        """Release windows and contexts. Never raises; may be called twice."""
