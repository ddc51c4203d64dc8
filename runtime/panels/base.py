"""Interface of the panel sinks: windows, offscreen, browser."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

from runtime.records import PanelFrame, PresentReport


class PanelSink(ABC):
    """An output to all panels of the stack. A frame is shown on all of them or on none."""

    name: str
    contexts_lost = 0  # GL contexts lost since the start. After a GPU reset, every other context is lost as well

    @property
    def period_ns(self) -> int | None:
        """Return the interval between vertical blanks of the monitor that sets the pace, or None if unknown."""
        return None

    @property
    def window_handles(self) -> list[Any]:
        """Return the GLFW handles of the open windows, for reading their keys."""
        return []

    @abstractmethod
    def present(self, frame: PanelFrame, *, unchanged: bool = False) -> PresentReport:
        """Show a frame on every panel: the solution is aligned, then mixed with the flat picture.

        The frame's arrays must not change until another frame has been presented: until then a sink may read them.
        unchanged: the caller guarantees that this frame shows the same picture as the previous one. Panels that still
        show it skip upload, drawing and swap, so the flat picture costs almost nothing while there is no viewer.
        Raises PanelLost; a later call rebuilds the panels.
        """

    @abstractmethod
    def close(self) -> None:
        """Release windows and contexts. Never raises; may be called twice."""
