"""Interface of all outputs to the panels."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

from runtime.records import PanelFrame, PresentReport


class PanelSink(ABC):
    """Base class of outputs, which show each frame on all panels of the stack or on none."""

    name: str
    contexts_lost = 0  # number of lost GL contexts; a GPU reset loses every context of the process

    @property
    def period_ns(self) -> int | None:
        """Refresh period of the monitor that sets the pace, or None if the period is unknown."""
        return None

    @property
    def window_handles(self) -> list[Any]:
        """GLFW handles of the open windows, for reading keys."""
        return []

    @abstractmethod
    def present(self, frame: PanelFrame, *, unchanged: bool = False) -> PresentReport:
        """Show a frame on every panel.

        The output aligns the solution and then mixes it with the flat picture. The caller must not change the arrays of
        the frame until it has presented another frame, because the output may still read them.

        Args:
            frame: Frame to show.
            unchanged: The caller guarantees that the frame shows the same picture as the previous frame. Panels that
                still show this picture do nothing, which makes the flat picture almost free while there is no viewer.

        Raises:
            PanelLost: A panel can no longer show frames. A later call tries to rebuild the panels.
        """

    @abstractmethod
    def close(self) -> None:
        """Release windows and contexts. The method never raises an exception and may be called twice."""
