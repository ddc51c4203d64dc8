"""The interface of panel sinks: windows, offscreen, browser."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

from runtime.records import PanelFrame, PresentReport


class PanelSink(ABC):
    """A sink for all panels of the stack; a frame is shown on all of them or on none."""

    name: str
    contexts_lost = 0  # so far: with the panels' GL context others on the same GPU are gone, too

    @property
    def period_ns(self) -> int | None:
        """Period between vertical blanks of the monitor that sets the pace; None: none, or unknown."""
        return None

    @property
    def window_handles(self) -> list[Any]:
        """GLFW handles of the open windows, for their keys."""
        return []

    @abstractmethod
    def present(self, frame: PanelFrame, *, unchanged: bool = False) -> PresentReport:
        """Show a frame on every panel: its solution aligned, then mixed with its flat picture.

        The frame's arrays stay as they are until another frame has been presented: a sink may read them as late as
        that. unchanged: the caller vouches that this shows what the frame before did: panels that still show it
        upload, draw and swap nothing, so that a picture without a viewer costs next to nothing.
        Raises PanelLost: rebuilt by a later call, the loop goes on.
        """

    @abstractmethod
    def close(self) -> None:
        """Release windows and contexts. May be called twice; never raises."""
