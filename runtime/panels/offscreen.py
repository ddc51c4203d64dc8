"""Panels without a screen, behind the same interface: for replay, tests and `solve`."""

from __future__ import annotations

import moderngl
import numpy as np

from runtime.clock import Clock
from runtime.config import PanelSettings
from runtime.errors import PanelLost
from runtime.panels.base import PanelSink
from runtime.panels.presentation import FrameTextures, Painter
from runtime.records import U8, PanelFrame, PresentReport
from runtime.support.gl_sharing import ShareGroup, shared


class OffscreenPanels(PanelSink):
    """N panels of equal size in one EGL context.

    `present` only keeps the frame: nobody looks, and an upload would cost a refresh up to 6 ms (three layers at
    1080p, llvmpipe). `read_back` uploads what is not there yet and draws.
    """

    name = "offscreen"

    def __init__(
        self,
        context: moderngl.Context,
        *,
        clock: Clock,
        width_px: int,
        height_px: int,
        panels: tuple[PanelSettings, ...],
    ) -> None:
        """`width_px` by `height_px` is the panel as the viewer sees it. Raises InputError for a bad curve."""
        self._context, self._clock = context, clock
        self._size = (width_px, height_px)
        self._frame: PanelFrame | None = None
        self._group = shared()
        self._textures = FrameTextures(context, self._size, count=len(panels), group=self._group)
        self._closed = False
        self._painters: list[Painter] = []
        self._targets: list[moderngl.Framebuffer] = []
        for settings in panels:
            screen = (height_px, width_px) if settings.rotation_deg in (90, 270) else (width_px, height_px)
            self._painters.append(Painter(context, settings, screen_px=screen, layer_px=self._size))
            self._targets.append(context.framebuffer([context.texture(screen, 4)]))

    @property
    def group(self) -> ShareGroup | None:
        return self._group

    def present(self, frame: PanelFrame, *, unchanged: bool = False) -> PresentReport:
        """Keep it, unless it is the one before."""
        self._textures.check(frame)
        if self._closed:
            raise PanelLost("offscreen panels: closed")
        if not unchanged or self._frame is None:
            self._frame = frame
        return PresentReport(frame.number, self._clock.now_ns(), 0.0)

    def read_back(self) -> tuple[U8, ...]:
        """The monitors' pictures of the last frame, rear to front: (h, w, 4) RGBA each, top row first.

        Raises ValueError before the first frame, PanelLost where the context is gone.
        """
        if self._frame is None:
            raise ValueError("nothing has been presented yet")
        self._draw(self._frame)
        pictures = []
        for target in self._targets:
            width, height = target.size
            bottom_up = np.frombuffer(target.read(components=4), np.uint8).reshape(height, width, 4)
            pictures.append(np.ascontiguousarray(bottom_up[::-1]))
        return tuple(pictures)

    def close(self) -> None:
        """Release textures and framebuffers; the context stays its owner's."""
        if self._painters:
            # moderngl binds the last framebuffer again on later calls: it must not be one that is no more.
            self._context.detect_framebuffer(0).use()
        for painter in self._painters:
            painter.release()
        for target in self._targets:
            for attachment in target.color_attachments:
                attachment.release()
            target.release()
        self._textures.release()
        if self._group is not None:
            self._group.close()
        self._closed, self._painters, self._targets = True, [], []

    def _draw(self, frame: PanelFrame) -> None:
        """Upload and draw. Raises PanelLost."""
        try:
            self._textures.upload(frame)
            for index, (target, painter) in enumerate(zip(self._targets, self._painters, strict=True)):
                target.use()
                painter.draw(self._textures, frame, index)
                self._context.finish()
            fault = self._context.error
        except Exception as error:  # a released or lost context answers with whatever moderngl has at hand
            raise PanelLost(f"offscreen panels: {error}") from error
        if fault != "GL_NO_ERROR":
            raise PanelLost(f"offscreen panels: {fault}")
