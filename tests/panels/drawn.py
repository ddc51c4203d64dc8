"""Offscreen panels that draw what monitors would receive, by the shader or on the processor, and read it back."""

from __future__ import annotations

import moderngl
import numpy as np

from runtime.clock import Clock
from runtime.config import PanelSettings
from runtime.optics.presentation import panel_draws
from runtime.optics.rect import PixelRect
from runtime.panels.presentation import FrameTextures, Painter, mount_of
from runtime.panels.processor import Mounting, ProcessorPainter
from runtime.panels.registry import OffscreenPanels
from runtime.records import U8, PanelFrame, PresentReport


class ReadPanels(OffscreenPanels):
    """Offscreen panels whose last frame can be read back."""

    def present(self, frame: PanelFrame, *, unchanged: bool = False, due_ns: int | None = None) -> PresentReport:
        self._frame = frame
        return super().present(frame, unchanged=unchanged)

    def read_back(self) -> tuple[U8, ...]:
        """The monitors' pictures of the last frame, rear to front: (h, w, 4) RGBA each, top row first."""
        raise NotImplementedError


class DrawnPanels(ReadPanels):
    """Offscreen panels whose `read_back` uploads missing layers and draws."""

    def __init__(
        self,
        context: moderngl.Context,
        *,
        clock: Clock,
        size_px: tuple[int, int],
        panels: tuple[PanelSettings, ...],
        screen_px: tuple[int, int] | None = None,
    ) -> None:
        super().__init__(clock)
        self._textures = FrameTextures(context, count=len(panels))
        self._context = context
        self._painters: list[Painter] = []
        self._targets: list[moderngl.Framebuffer] = []
        for settings in panels:
            screen = screen_px or (size_px[::-1] if settings.rotation_deg in (90, 270) else size_px)
            alike = [painter for painter, other in zip(self._painters, panels, strict=False) if other == settings]
            mount = mount_of(settings, screen_px=screen, layer_px=size_px)
            self._painters.append(alike[0] if alike else Painter(context, mount))  # compiling shaders is slow
            self._targets.append(context.framebuffer([context.texture(screen, 4)]))

    def read_back(self) -> tuple[U8, ...]:
        pictures = []
        self._textures.upload(self._frame)
        draws = panel_draws(self._frame, [painter.mount for painter in self._painters])
        for index, (target, painter, draw) in enumerate(zip(self._targets, self._painters, draws, strict=True)):
            target.use()
            painter.draw(self._textures, draw, index)
            width, height = target.size
            bottom_up = np.frombuffer(target.read(components=4), np.uint8).reshape(height, width, 4)
            pictures.append(np.ascontiguousarray(bottom_up[::-1]))
        assert self._context.error == "GL_NO_ERROR"
        return tuple(pictures)

    def close(self) -> None:
        if self._painters:
            # moderngl binds the last framebuffer again on later calls: it must not be a deleted one.
            self._context.detect_framebuffer(0).use()
        for painter in set(self._painters):
            painter.release()
        for target in self._targets:
            for attachment in target.color_attachments:
                attachment.release()
            target.release()
        self._textures.release()
        self._painters, self._targets = [], []
        super().close()


class ProcessorDrawnPanels(ReadPanels):
    """Offscreen panels drawn on the processor."""

    def __init__(self, *, clock: Clock, size_px: tuple[int, int], panels: tuple[PanelSettings, ...]) -> None:
        super().__init__(clock)
        self._screens, mountings, mounts = [], [], []
        for settings in panels:
            screen = size_px[::-1] if settings.rotation_deg in (90, 270) else size_px
            mounting = Mounting.of(settings, screen_px=screen, layer_px=size_px)
            mountings.append(mounting)
            mounts.append(mount_of(settings, screen_px=screen, layer_px=size_px))
            self._screens.append(np.zeros((*screen[::-1], 4), np.uint8))
        self._painter = ProcessorPainter(mounts, mountings, self._screens)

    def drawn(self, frame: PanelFrame) -> dict[int, PixelRect]:
        """The part of each panel's picture that a frame changes, by the panel's number."""
        return self._painter.draw(frame)

    def read_back(self) -> tuple[U8, ...]:
        self._painter.draw(self._frame)
        return tuple(screen[..., [2, 1, 0, 3]] for screen in self._screens)
