"""Interface of the outputs to the panels."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

from runtime.records import PanelFrame, PresentReport


class PanelSink(ABC):
    """Output to all panels of the stack. A frame appears on all of them or on none."""

    name: str
    contexts_lost = 0  # number of GL contexts lost; a GPU reset loses all other contexts, too

    @property
    def period_ns(self) -> int | None:
        """Refresh period of the monitor that sets the pace, or None if unknown."""
        return None

    @property
    def window_handles(self) -> list[Any]:
        """GLFW handles of the open windows, from which keys can be read."""
        return []

    @abstractmethod
    def present(self, frame: PanelFrame, *, unchanged: bool = False) -> PresentReport:
        """Show a frame on every panel. The solution is aligned, then mixed with the flat picture.

        The arrays of the frame must not change until another frame has been presented, because a sink may read them.
        unchanged: the caller guarantees that this frame shows the same picture as the previous one. Panels that still
        show it do nothing, so the flat picture costs almost nothing while there is no viewer. Raises PanelLost, after
        which a later call rebuilds the panels.
        """

    @abstractmethod
    def close(self) -> None:
        """Release windows and contexts. Never raises. May be called twice."""
