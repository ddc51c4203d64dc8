"""Panels without a screen, behind the same interface: for replay, tests and `solve`."""

from __future__ import annotations

import moderngl
import numpy as np

from runtime.clock import NS_PER_MS, Clock
from runtime.config import PanelSettings
from runtime.errors import PanelLost
from runtime.panels.base import PanelSink
from runtime.panels.presentation import Mounting, Painter
from runtime.records import U8, LayerFrame, PresentReport


class OffscreenPanels(PanelSink):
    """N panels of equal size in one EGL context.

    `present` uploads the frame, once for all panels (0.2 ms a panel at 1080p on llvmpipe), and draws nothing:
    nobody looks. With `draw` it also runs each panel's presentation shader (13 to 28 ms a panel at 1080p on
    llvmpipe, next to nothing on a GPU), as windows do. `read_back` draws in any case.
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
        draw: bool = False,
    ) -> None:
        """`width_px` by `height_px` is the panel as the viewer sees it. Raises InputError for a bad curve."""
        self._context, self._clock, self._draw = context, clock, draw
        self._size = (width_px, height_px)
        self._count = len(panels)
        self._number = -1
        self._layers = context.texture_array((width_px, height_px, self._count), 4)
        self._layers.filter = (moderngl.LINEAR, moderngl.LINEAR)
        self._layers.repeat_x = self._layers.repeat_y = False
        self._painters: list[Painter] = []
        self._targets: list[moderngl.Framebuffer] = []
        for settings in panels:
            sideways = settings.rotation_deg in (90, 270)
            screen = (height_px, width_px) if sideways else (width_px, height_px)
            mounting = Mounting.of(
                settings,
                screen_width_px=screen[0],
                screen_height_px=screen[1],
                layer_width_px=width_px,
                layer_height_px=height_px,
            )
            self._painters.append(Painter(context, mounting))
            self._targets.append(context.framebuffer([context.texture(screen, 4)]))

    def present(self, frame: LayerFrame, *, unchanged: bool = False) -> PresentReport:
        """Upload (and draw, if asked to at construction); skew is between the first and the last panel drawn."""
        if frame.layers.shape != (self._count, self._size[1], self._size[0], 4):
            raise ValueError(f"layers are {frame.layers.shape}, the panels {self._count} of {self._size}")
        if unchanged and self._number >= 0:
            self._number = frame.number
            return PresentReport(frame.number, self._clock.now_ns(), 0.0)
        try:
            self._layers.write(np.ascontiguousarray(frame.layers))
            finished_ns = [self._paint(index) for index in range(self._count)] if self._draw else []
            fault = self._context.error
        except Exception as error:  # a released or lost context answers with whatever moderngl has at hand
            raise PanelLost(f"offscreen panels: {error}") from error
        if fault != "GL_NO_ERROR":
            raise PanelLost(f"offscreen panels: {fault}")
        self._number = frame.number
        done_ns = self._clock.now_ns()
        skew_ns = finished_ns[-1] - finished_ns[0] if finished_ns else 0
        return PresentReport(frame.number, done_ns, skew_ns / NS_PER_MS)

    def read_back(self) -> tuple[U8, ...]:
        """The monitors' pictures of the last frame, rear to front: (h, w, 4) RGBA each, top row first.

        Raises ValueError before the first frame.
        """
        if self._number < 0:
            raise ValueError("nothing has been presented yet")
        pictures = []
        for index, target in enumerate(self._targets):
            self._paint(index)
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
        if self._painters:
            self._layers.release()
        self._painters, self._targets = [], []

    def _paint(self, index: int) -> int:
        self._targets[index].use()
        self._painters[index].draw(self._layers, index)
        self._context.finish()
        return self._clock.now_ns()
