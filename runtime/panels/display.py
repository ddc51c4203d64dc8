"""GLFW on X11: monitors, and windows that share GL objects. For the main thread only."""

from __future__ import annotations

import logging
import re
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import glfw as _glfw
import moderngl

from runtime.errors import MissingPart, PanelLost
from runtime.panels import edid, xlib
from runtime.panels.monitors import Monitor, Rectangle, in_order
from runtime.support.gl import MINIMUM_VERSION

log = logging.getLogger("phasestack.panels")

glfw: Any = _glfw  # untyped, because its stubs are wrong about bytes, None and pointers

# The binding would otherwise turn errors into warnings.
glfw.ERROR_REPORTING = "exception"


@cache
def gl_function(name: str) -> int:
    """Return the address of an OpenGL function, or 0 if it is missing. It is the same in all contexts.

    Cached, because moderngl keeps references to all functions, which take 20 KiB per context.
    """
    return int(glfw.get_proc_address(name) or 0)


class WindowContext:
    """Adapter of a GLFW window for moderngl, which loads functions and makes the context current."""

    def __init__(self, window: Any) -> None:
        self._window = window

    def load_opengl_function(self, name: str) -> int:
        """Return the address of an OpenGL function."""
        return gl_function(name)

    load = load_opengl_function

    def __enter__(self) -> None:
        glfw.make_context_current(self._window)

    def __exit__(self, *exception: object) -> None:
        """Leave the context current."""

    def release(self) -> None:
        """Do nothing, because the window owns the context."""


@dataclass(eq=False)
class Window:
    """GLFW window with its moderngl context."""

    handle: Any
    context: moderngl.Context
    faults: list[str] = field(default_factory=list)  # faults reported by callbacks

    def make_current(self) -> None:
        """Make the window's context current on this thread."""
        glfw.make_context_current(self.handle)


watch: xlib.ServerWatch | None = None  # watches the connection of this process


def _connect() -> None:
    """Connect GLFW to the X server until the process ends.

    The connection stays open because, when the panels lose their contexts, another thread may still use a context of
    the same EGL display. If GLFW closed that display, Mesa would use freed memory.
    Raises PanelLost if no X server can be reached, and MissingPart if GLFW does not use X11.
    """
    global watch
    if watch is not None:
        glfw.poll_events()  # updates the list of monitors
        return
    try:
        if glfw.platform_supported(glfw.PLATFORM_X11):
            glfw.init_hint(glfw.PLATFORM, glfw.PLATFORM_X11)
        glfw.init()
    except glfw.GLFWError as error:
        raise PanelLost(f"no X server is available: {_text(error)}; check DISPLAY and XAUTHORITY") from None
    if glfw.get_platform() != glfw.PLATFORM_X11:
        raise MissingPart("GLFW does not use X11, but placing windows on monitors requires X11; start an X server")
    xlib.take_over_errors()
    watch = xlib.ServerWatch(_pointer())


class Display:
    """Windows on the X server. A hidden root window owns the GL objects that all others share.

    `close` closes every window. If the X server dies, the process ends (see `xlib.take_over_errors`).
    """

    def __init__(self) -> None:
        """Connect. Raises PanelLost if the X server cannot be used, and MissingPart without an X11 library."""
        self.faults: list[str] = []
        self._windows: list[Window] = []
        self._outputs: dict[str, int] = {}
        _connect()
        glfw.set_monitor_callback(self._monitor_changed)

    @property
    def root(self) -> Window:
        """Hidden root window, created on first use because listing monitors needs no OpenGL.

        Raises PanelLost if the X server does not support OpenGL.
        """
        if not self._windows:
            _hints()
            glfw.window_hint(glfw.VISIBLE, False)
            try:
                self._adopt(glfw.create_window(16, 16, "phasestack", None, None))
            except glfw.GLFWError as error:
                raise PanelLost(f"the X server does not support OpenGL: {_text(error)}") from None
        return self._windows[0]

    def monitors(self) -> tuple[Monitor, ...]:
        """Return the active monitors, from left to right."""
        return in_order([monitor for monitor, _ in self._pairs()])

    def fullscreen_window(self, monitor: Monitor, *, title: str) -> Window:
        """Open a borderless window that fills a monitor, and make its context current.

        Raises PanelLost if the monitor is no longer connected or the X server does not support OpenGL.
        """
        share = self.root.handle
        handles = {connected.connector: handle for connected, handle in self._pairs()}
        if monitor.connector not in handles:
            raise PanelLost(f"{monitor.connector} is no longer connected")
        glfw.window_hint(glfw.VISIBLE, True)
        handle = glfw.create_window(monitor.width_px, monitor.height_px, title, handles[monitor.connector], share)
        return self._adopt(handle)

    def poll(self) -> str:
        """Process X events. Returns faults that make the windows useless, or an empty string."""
        glfw.poll_events()
        faults = self.faults + [fault for window in self._windows for fault in window.faults]
        return "; ".join(faults)

    def close_windows(self) -> None:
        """Close all windows except the hidden root."""
        self._close_from(1)
        self.faults.clear()
        if self._windows:
            self._windows[0].make_current()

    def close(self) -> None:
        """Close every window. May be called twice."""
        if self._windows:
            glfw.make_context_current(None)
        self._close_from(0)

    def _close_from(self, first: int) -> None:
        for window in self._windows[first:]:
            window.context.release()
            glfw.destroy_window(window.handle)
        self._windows = self._windows[:first]

    def _adopt(self, handle: Any) -> Window:
        glfw.make_context_current(handle)
        context = _attach(handle)
        window = Window(handle, context)

        def closed(_handle: Any) -> None:
            window.faults.append("a panel's window was closed")

        glfw.set_window_close_callback(handle, closed)
        glfw.set_input_mode(handle, glfw.CURSOR, glfw.CURSOR_HIDDEN)
        self._windows.append(window)
        return window

    def output_state(self, connector: str) -> xlib.OutputState | None:
        """Return the mode and monitor of an output, or None if it is off or disconnected."""
        output = self._outputs.get(connector)
        return xlib.output_state(_pointer(), output) if output else None

    def window_state(self, window: Window) -> tuple[bool, Rectangle] | None:
        """Return whether a window is mapped and its position, or None if it was destroyed."""
        refused = xlib.refusals()
        place = Rectangle(*glfw.get_window_pos(window.handle), *glfw.get_window_size(window.handle))
        is_viewable = bool(glfw.get_window_attrib(window.handle, glfw.VISIBLE))
        return (is_viewable, place) if xlib.refusals() == refused else None

    def _pairs(self) -> list[tuple[Monitor, Any]]:
        self._outputs, pairs = {}, []
        for handle in glfw.get_monitors():
            connector = glfw.get_monitor_name(handle).decode()
            self._outputs[connector] = glfw.get_x11_monitor(handle)
            mode = glfw.get_video_mode(handle)
            x_px, y_px = glfw.get_monitor_pos(handle)
            state = self.output_state(connector)
            identity = edid.parse(state.edid) if state is not None and state.edid else None
            # GLFW rounds the refresh rate to an integer.
            refresh_hz = state.refresh_hz if state is not None and state.refresh_hz else float(mode.refresh_rate)
            monitor = Monitor(
                connector=connector,
                serial=identity.serial if identity else "",
                model=" ".join(part for part in (identity.maker, identity.name) if part) if identity else "",
                x_px=x_px,
                y_px=y_px,
                width_px=mode.size.width,
                height_px=mode.size.height,
                refresh_hz=refresh_hz,
            )
            pairs.append((monitor, handle))
        return pairs

    def _monitor_changed(self, handle: Any, what: int) -> None:
        name = glfw.get_monitor_name(handle).decode()
        self.faults.append(f"{name} was {'connected' if what == glfw.CONNECTED else 'disconnected'}")

    @property
    def has_windows(self) -> bool:
        """True if there are windows other than the hidden root."""
        return len(self._windows) > 1


def connected_monitors() -> tuple[Monitor, ...]:
    """Return the active monitors, left to right. Raises PanelLost without an X server or a monitor."""
    display = Display()
    try:
        monitors = display.monitors()
    finally:
        display.close()
    if not monitors:
        raise PanelLost("no monitor is active on the X server")
    return monitors


def _attach(handle: Any) -> moderngl.Context:
    settings: dict[str, Any] = {"context": WindowContext(handle)}
    return moderngl.create_context(require=MINIMUM_VERSION, **settings)


def _hints() -> None:
    glfw.default_window_hints()
    # EGL, like the offscreen context, because a thread cannot switch between GLX and EGL contexts.
    glfw.window_hint(glfw.CONTEXT_CREATION_API, glfw.EGL_CONTEXT_API)
    glfw.window_hint(glfw.CONTEXT_VERSION_MAJOR, MINIMUM_VERSION // 100)
    glfw.window_hint(glfw.CONTEXT_VERSION_MINOR, MINIMUM_VERSION // 10 % 10)
    glfw.window_hint(glfw.OPENGL_PROFILE, glfw.OPENGL_CORE_PROFILE)
    glfw.window_hint(glfw.CONTEXT_ROBUSTNESS, glfw.LOSE_CONTEXT_ON_RESET)
    glfw.window_hint(glfw.AUTO_ICONIFY, False)
    glfw.window_hint(glfw.FOCUS_ON_SHOW, False)
    glfw.window_hint(glfw.RESIZABLE, False)


def _pointer() -> int:
    pointer = glfw.get_x11_display()
    return int(getattr(pointer, "value", pointer) or 0)


def _text(error: Exception) -> str:
    return re.sub(r"^\(\d+\) b?['\"]?(.*?)['\"]?$", r"\1", str(error)) or type(error).__name__
