"""Interface shared by all outputs to the panels."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

from runtime.records import PanelFrame, PresentReport


class PanelSink(ABC):
    """Base class for outputs, which show each frame on all of the stack's panels or on none."""

    name: str
    contexts_lost = 0  # number of lost GL contexts; after a GPU reset, all of the process's contexts are lost

    @property
    def period_ns(self) -> int | None:
        """Refresh period of the monitor that sets the pace, or None if unknown."""
        return None

    @property
    def window_handles(self) -> list[Any]:
        """GLFW handles of all open windows, used to read keys."""
        return []

    @abstractmethod
    def present(self, frame: PanelFrame, *, unchanged: bool = False, due_ns: int | None = None) -> PresentReport:
        """Show a frame on every panel: the solution, aligned, and then mixed with the flat picture.

        The output may read the frame's arrays until it has presented another frame. A frame that is `unchanged`,
        certain to show the same picture, is skipped by a panel that shows it already. An output without vertical blanks
        waits until `due_ns` on the run's clock. Raises PanelLost if a panel can no longer show frames; later calls try
        to reopen them.
        """

    @abstractmethod
    def close(self) -> None:
        """Release all windows and contexts. Never raises an exception. May be called more than once."""
