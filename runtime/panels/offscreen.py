"""Panels without a screen, behind the same interface: for replay, tests and `solve`."""

from __future__ import annotations

from runtime.clock import Clock
from runtime.errors import PanelLost
from runtime.panels.base import PanelSink
from runtime.records import PanelFrame, PresentReport
from runtime.support.gl_sharing import ShareGroup, shared


class OffscreenPanels(PanelSink):
    """N panels of equal size that nobody looks at: the newest frame is held, not drawn."""

    name = "offscreen"

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._group = shared()
        self._frame: PanelFrame | None = None
        self._closed = False

    @property
    def group(self) -> ShareGroup | None:
        return self._group

    def present(self, frame: PanelFrame, *, unchanged: bool = False) -> PresentReport:
        if self._closed:
            raise PanelLost("offscreen panels: closed")
        if not unchanged or self._frame is None:
            self._frame = frame
        return PresentReport(frame.number, self._clock.now_ns(), 0.0)

    def close(self) -> None:
        if self._group is not None:
            self._group.close()
        self._closed = True
