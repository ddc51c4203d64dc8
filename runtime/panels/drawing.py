"""Fullscreen windows, one for each panel, drawn by OpenGL or, if the PC has no GPU, by the processor."""

from __future__ import annotations

import ctypes
import logging
from abc import ABC, abstractmethod
from collections.abc import Sequence

import moderngl

from runtime.clock import Clock
from runtime.config import PanelSettings
from runtime.errors import PanelLost
from runtime.optics.presentation import Mount, panel_draws
from runtime.optics.rect import PixelRect
from runtime.panels.display import Display, Window, gl_function, glfw, x_display
from runtime.panels.monitors import Monitor
from runtime.panels.presentation import FrameTextures, Painter, mount_of
from runtime.panels.processor import Mounting, ProcessorPainter
from runtime.panels.shared_picture import NotShared, SharedPicture, finish, flush
from runtime.records import PanelFrame
from runtime.support.gl import draws_in_software

COPIES = 4  # copies of each picture to measure how long they take

log = logging.getLogger("phasestack.panels")


class WindowContextLost(PanelLost):
    """An OpenGL context failed and must be replaced."""


class PanelWindows(ABC):
    """Open windows, rear to front. A frame is drawn for all panels before it is shown on any."""

    opengl: bool  # True if OpenGL draws; then, showing a frame waits for the first monitor's vertical blank

    def __init__(self) -> None:
        self.windows: list[Window] = []

    @property
    def show_ns(self) -> int:
        """Time from calling `show` until all panels show a new frame. 0 if unknown."""
        return 0

    @property
    def damaged(self) -> bool:
        """True if a window no longer shows the last frame and must be shown again."""
        return False

    @abstractmethod
    def draw(self, frame: PanelFrame) -> None:
        """Draw a frame for all panels, without showing it. Raises WindowContextLost."""

    @abstractmethod
    def show(self, clock: Clock) -> tuple[int, int]:
        """Show the frame on all panels; return when the first and the last one show it, on `clock`."""

    @abstractmethod
    def release(self) -> None:
        """Release everything except the windows, before they are closed."""

    @abstractmethod
    def abandon(self) -> None:
        """Release everything that does not belong to an OpenGL context. Called if the contexts may be lost."""


class ShaderWindows(PanelWindows):
    """Windows drawn by OpenGL, from textures shared by all of them."""

    opengl = True

    def __init__(self, display: Display, monitors: Sequence[Monitor], mounts: Sequence[Mount]) -> None:
        """Open the windows. Raises PanelLost if a monitor is no longer connected, or X does not support OpenGL."""
        super().__init__()
        self._display = display
        self._textures = FrameTextures(display.root.gl, count=len(mounts))
        self._painters: list[Painter] = []
        try:
            for number, (mount, monitor) in enumerate(zip(mounts, monitors, strict=True)):
                window = display.fullscreen_window(monitor, title=f"panel {number}")
                self.windows.append(window)
                self._painters.append(Painter(window.gl, mount))
                glfw.swap_interval(1 if number == 0 else 0)
        except BaseException:
            self.release()
            raise

    def draw(self, frame: PanelFrame) -> None:
        root = self._display.root
        if any(self._textures.lacks(frame)):
            root.make_current()
            self._textures.upload(frame)
            # The other contexts may not use the textures until the upload has finished.
            root.gl.finish()
        draws = panel_draws(frame, [painter.mount for painter in self._painters])
        for panel, (window, painter, draw) in enumerate(zip(self.windows, self._painters, draws, strict=True)):
            window.make_current()
            context = window.gl
            context.viewport = (0, 0, *painter.mount.screen_px)
            painter.draw(self._textures, draw, panel)
            context.finish()
            if fault := _reset_status() or _error(context):
                raise WindowContextLost(f"the OpenGL context of panel {panel} failed: {fault}")

    def show(self, clock: Clock) -> tuple[int, int]:
        swapped_ns = []
        for window in self.windows:
            window.make_current()
            glfw.swap_buffers(window.handle)
            swapped_ns.append(clock.now_ns())
        return swapped_ns[0], swapped_ns[-1]

    def release(self) -> None:
        for window, painter in zip(self.windows, self._painters, strict=False):  # the last one may have none
            window.make_current()
            painter.release()
        self._textures.release()

    def abandon(self) -> None:
        """Do nothing, because everything belongs to the contexts."""


class ProcessorWindows(PanelWindows):
    """Windows drawn by the processor, into memory shared with X, which does not report vertical blanks."""

    opengl = False

    def __init__(
        self,
        display: Display,
        monitors: Sequence[Monitor],
        mounts: Sequence[Mount],
        mountings: Sequence[Mounting],
        clock: Clock,
    ) -> None:
        """Open the windows. Raises PanelLost without a monitor, NotShared if X cannot reach this process's memory."""
        super().__init__()
        self._pictures: list[SharedPicture] = []
        self._changed: dict[int, PixelRect] = {}  # changed parts of the pictures
        try:
            for number, monitor in enumerate(monitors):
                window = display.fullscreen_window(monitor, title=f"panel {number}", opengl=False)
                self.windows.append(window)
                width_px, height_px = monitor.size_px
                self._pictures.append(
                    SharedPicture(
                        x_display(), glfw.get_x11_window(window.handle), width_px=width_px, height_px=height_px
                    )
                )
            screens = [picture.pixels for picture in self._pictures]
            self._painter = ProcessorPainter(mounts, mountings, screens)
            self._copy_ns = self._measured_copy_ns(clock)
        except BaseException:
            self.release()
            raise

    @property
    def show_ns(self) -> int:
        return len(self._pictures) * self._copy_ns

    @property
    def damaged(self) -> bool:
        return any(window.exposed for window in self.windows)

    def draw(self, frame: PanelFrame) -> None:
        finish(x_display())  # the X server may still be copying the last frame
        self._changed = self._painter.draw(frame)

    def show(self, clock: Clock) -> tuple[int, int]:
        shown = 0
        for panel, (window, picture) in enumerate(zip(self.windows, self._pictures, strict=True)):
            if panel in self._changed or window.exposed:
                part = None if window.exposed else self._changed[panel]
                window.exposed = False
                picture.put(part)
                shown += 1
        flush(x_display())
        # The X server copies the pictures meanwhile. Waiting for it would leave too little time to draw the next frame.
        now_ns = clock.now_ns()
        return now_ns + min(shown, 1) * self._copy_ns, now_ns + shown * self._copy_ns

    def release(self) -> None:
        for picture in self._pictures:
            picture.close()

    def _measured_copy_ns(self, clock: Clock) -> int:
        """Return how long the X server takes to copy a picture, from copying the black pictures several times."""
        copies_ns = []
        for _ in range(COPIES):  # the first is slow, because the server has not used the memory yet
            finish(x_display())
            began_ns = clock.now_ns()
            for picture in self._pictures:
                picture.put()
            finish(x_display())
            copies_ns.append(clock.now_ns() - began_ns)
        return min(copies_ns) // len(self._pictures)

    def abandon(self) -> None:
        self.release()


def open_windows(
    display: Display,
    panels: Sequence[PanelSettings],
    monitors: Sequence[Monitor],
    *,
    layer_px: tuple[int, int],
    clock: Clock,
    on_processor: bool | None = None,
) -> PanelWindows:
    """Open a fullscreen window for each panel. `on_processor` draws there if possible, or if None where
    OpenGL would too. Raises InputError for an invalid grey curve, and PanelLost if a monitor is no longer connected or
    the X server does not support OpenGL.
    """
    mounts = [
        mount_of(panel, screen_px=monitor.size_px, layer_px=layer_px)
        for panel, monitor in zip(panels, monitors, strict=True)
    ]
    root = display.root  # must be the first window
    if draws_in_software(root.gl) if on_processor is None else on_processor:
        windows = _processor_windows(display, panels, monitors, mounts, layer_px, clock)
        if windows is not None:
            return windows
    return ShaderWindows(display, monitors, mounts)


def _processor_windows(
    display: Display,
    panels: Sequence[PanelSettings],
    monitors: Sequence[Monitor],
    mounts: Sequence[Mount],
    layer_px: tuple[int, int],
    clock: Clock,
) -> ProcessorWindows | None:
    """Open windows drawn by the processor, or return None and log why that is impossible."""
    mountings = [
        Mounting.of(panel, screen_px=monitor.size_px, layer_px=layer_px)
        for panel, monitor in zip(panels, monitors, strict=True)
    ]
    try:
        windows = ProcessorWindows(display, monitors, mounts, mountings, clock)
    except NotShared as error:
        log.warning("there is no GPU, and %s: drawing will be slow", error)
        display.close_windows()
        return None
    log.info("there is no GPU: the panels are drawn on the processor")
    return windows


def _error(context: moderngl.Context) -> str:
    fault = context.error
    return "" if fault == "GL_NO_ERROR" else fault


def _reset_status() -> str:
    """Return the driver's status after a GPU reset, or "" if the GPU has not been reset."""
    address = gl_function("glGetGraphicsResetStatus")
    status: int = ctypes.CFUNCTYPE(ctypes.c_uint)(address)() if address else 0
    return f"the driver reset the GPU (0x{status:x})" if status else ""
