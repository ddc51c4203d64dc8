"""Panels without a screen, behind the same interface: for replay, tests and `solve`."""

from __future__ import annotations

import moderngl

from runtime.clock import Clock
from runtime.config import PanelSettings
from runtime.errors import PanelLost
from runtime.panels.base import PanelSink
from runtime.panels.presentation import FrameTextures
from runtime.records import PanelFrame, PresentReport
from runtime.support.gl_sharing import ShareGroup, shared


class OffscreenPanels(PanelSink):
    """N panels of equal size that nobody looks at: the newest frame is checked and held, not drawn."""

    name = "offscreen"

    def __init__(
        self, context: moderngl.Context, *, clock: Clock, size_px: tuple[int, int], panels: tuple[PanelSettings, ...]
    ) -> None:
        """size_px: columns and rows of a panel as the viewer sees it."""
        self._clock = clock
        self._group = shared()
        self._textures = FrameTextures(context, size_px, count=len(panels), group=self._group)
        self._frame: PanelFrame | None = None
        self._closed = False

    @property
    def group(self) -> ShareGroup | None:
        return self._group

    def present(self, frame: PanelFrame, *, unchanged: bool = False) -> PresentReport:
        self._textures.check(frame)
        if self._closed:
            raise PanelLost("offscreen panels: closed")
        if not unchanged or self._frame is None:
            self._frame = frame
        return PresentReport(frame.number, self._clock.now_ns(), 0.0)

    def close(self) -> None:
        if self._group is not None:
            self._group.close()
        self._closed = True
