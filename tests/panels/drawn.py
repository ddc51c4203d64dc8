"""Offscreen panels that draw what monitors would receive, by the shader or on the processor, and read it back."""

from __future__ import annotations

from typing import Any

import moderngl
import numpy as np

from runtime.clock import Clock, SimulatedClock
from runtime.config import PanelSettings
from runtime.optics.presentation import panel_draws
from runtime.optics.rect import PixelRect
from runtime.panels.presentation import FrameTextures, Painter, mount_of
from runtime.panels.processor import Mounting, ProcessorPainter
from runtime.panels.registry import OffscreenPanels
from runtime.records import U8, PanelFrame, PresentReport

Size = tuple[int, int]


class ReadPanels(OffscreenPanels):
    """Offscreen panels whose last frame can be read back."""

    def __init__(
        self, *, clock: Clock, size_px: Size, panels: tuple[PanelSettings, ...], screen_px: Size | None = None
    ) -> None:
        super().__init__(clock)
        self._settings = panels
        sizes = [screen_px or (size_px[::-1] if one.rotation_deg in (90, 270) else size_px) for one in panels]
        self._how = [{"screen_px": screen, "layer_px": size_px} for screen in sizes]
        self._mounts = [mount_of(one, **how) for one, how in zip(panels, self._how, strict=True)]

    def present(self, frame: PanelFrame, *, unchanged: bool = False, due_ns: int | None = None) -> PresentReport:
        self._frame = frame
        return super().present(frame, unchanged=unchanged)

    def read_back(self) -> tuple[U8, ...]:
        """The monitors' pictures of the last frame, rear to front: (h, w, 4) RGBA each, top row first."""
        raise NotImplementedError


class DrawnPanels(ReadPanels):
    """Offscreen panels whose `read_back` uploads missing layers and draws."""

    def __init__(self, context: moderngl.Context, **panels: Any) -> None:
        super().__init__(**panels)
        self._textures = FrameTextures(context, count=len(self._mounts))
        self._context = context
        self._painters: list[Painter] = []
        self._targets: list[moderngl.Framebuffer] = []
        for settings, mount in zip(self._settings, self._mounts, strict=True):
            alike = [one for one, other in zip(self._painters, self._settings, strict=False) if other == settings]
            self._painters.append(alike[0] if alike else Painter(context, mount))  # compiling shaders is slow
            self._targets.append(context.framebuffer([context.texture(mount.screen_px, 4)]))

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

    def __init__(self, **panels: Any) -> None:
        super().__init__(**panels)
        mountings = [Mounting.of(one, **how) for one, how in zip(self._settings, self._how, strict=True)]
        self._screens = [np.zeros((*mount.screen_px[::-1], 4), np.uint8) for mount in self._mounts]
        self._painter = ProcessorPainter(self._mounts, mountings, self._screens)

    def drawn(self, frame: PanelFrame) -> dict[int, PixelRect]:
        """The part of each panel's picture that a frame changes, by the panel's number."""
        return self._painter.draw(frame)

    def read_back(self) -> tuple[U8, ...]:
        self._painter.draw(self._frame)
        return tuple(screen[..., [2, 1, 0, 3]] for screen in self._screens)


def drawn_panels(context: moderngl.Context | None, size_px: Size, *panels: PanelSettings, **how: Any) -> Any:
    """Panels that the shader draws, or without a context the processor."""
    told = {"clock": SimulatedClock(), "size_px": size_px, "panels": panels, **how}
    return ProcessorDrawnPanels(**told) if context is None else DrawnPanels(context, **told)
