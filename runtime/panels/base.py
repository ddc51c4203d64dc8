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
        """Show a frame on every panel.

        The output aligns the solution and then mixes it with the flat picture. The caller must not change the frame's
        arrays until it has presented another frame, because the output may still be reading them.

        Args:
            unchanged: True if the frame is certain to show the same picture as the previous one. A panel that is
                already showing this picture then skips the update, so displaying the flat picture with no viewer
                present costs almost nothing.
            due_ns: When the panels should show the frame, on the run's clock. An output without vertical blanks waits
                until then if it has drawn the frame earlier.

        Raises:
            PanelLost: A panel can no longer show frames. Later calls try to reopen the panels.
        """

    @abstractmethod
    def close(self) -> None:
        """Release all windows and contexts. Never raises an exception. May be called more than once."""
