"""List monitors, and open windows that share GL objects, using GLFW on X11.

For use only on the main thread.
"""

from __future__ import annotations

import importlib
import logging
import os
import re
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import moderngl
import numpy as np

from runtime.errors import MissingPart, PanelLost
from runtime.panels import edid, xlib
from runtime.panels.monitors import Monitor, Rectangle, in_order
from runtime.support.gl import MINIMUM_VERSION

log = logging.getLogger("phasestack.panels")

# In a Wayland session, the Python binding loads a GLFW without X11, even if DISPLAY names an X server.
os.environ.setdefault("PYGLFW_LIBRARY_VARIANT", "x11")
glfw: Any = importlib.import_module("glfw")  # untyped: GLFW's stubs are wrong about bytes, None and pointers

# By default, the Python binding turns errors into warnings.
glfw.ERROR_REPORTING = "exception"


@cache
def gl_function(name: str) -> int:
    """Return an OpenGL function's address, the same in all contexts, or 0. It is cached because moderngl
    keeps references to all functions, which take 20 KiB per context.
    """
    return int(glfw.get_proc_address(name) or 0)


class _Functions:
    """OpenGL's functions for moderngl. `Window.make_current` makes contexts current."""

    def load_opengl_function(self, name: str) -> int:
        """Return an OpenGL function's address, or 0."""
        return gl_function(name)

    load = load_opengl_function

    def release(self) -> None:
        """Do nothing, because contexts belong to their windows."""


@dataclass(eq=False)
class Window:
    """A GLFW window and its moderngl context."""

    handle: Any
    context: moderngl.Context | None  # None if OpenGL does not draw in this window
    faults: list[str] = field(default_factory=list)  # faults reported by callbacks
    exposed: bool = False  # True if the X server has lost a part of the window's picture

    @property
    def gl(self) -> moderngl.Context:
        """The window's context, in windows that have one."""
        assert self.context is not None
        return self.context

    def make_current(self) -> None:
        """Make the window's context current on this thread."""
        glfw.make_context_current(self.handle)


watch: xlib.ServerWatch | None = None  # watches this process's connection to the X server


def _connect() -> None:
    """Connect GLFW to the X server until the process ends. Raises PanelLost without one, and MissingPart without X11.
    The connection is kept open because, after the panels have lost their contexts, another thread may still be using a
    context of the same EGL display. If GLFW closed the EGL display, Mesa would access freed memory.
    """
    global watch
    if watch is not None:
        glfw.poll_events()  # this updates the list of monitors
        return
    try:
        if glfw.platform_supported(glfw.PLATFORM_X11):
            glfw.init_hint(glfw.PLATFORM, glfw.PLATFORM_X11)
        glfw.init()
    except glfw.GLFWError as error:
        raise PanelLost(f"no X server is available: {_text(error)}; check DISPLAY and XAUTHORITY") from None
    if glfw.get_platform() != glfw.PLATFORM_X11:
        raise MissingPart("GLFW is not using X11, which is required to place windows on monitors; start an X server")
    xlib.take_over_errors()
    watch = xlib.ServerWatch(x_display())


class Display:
    """Opens and closes windows on the X server, and lists the monitors. A hidden root window owns the GL
    objects shared by all other windows. If the X server dies, the process ends (see `xlib.take_over_errors`).
    """

    def __init__(self) -> None:
        """Connect to the X server. Raises PanelLost without one, and MissingPart if an X11 library is missing."""
        self.faults: list[str] = []
        self._windows: list[Window] = []
        self._outputs: dict[str, int] = {}
        _connect()
        glfw.set_monitor_callback(self._monitor_changed)

    @property
    def root(self) -> Window:
        """The hidden root window, created on first use. Raises PanelLost without OpenGL."""
        if not self._windows:
            _hints()
            glfw.window_hint(glfw.VISIBLE, False)
            try:
                self._adopt(glfw.create_window(16, 16, "phasestack", None, None))
            except glfw.GLFWError as error:
                raise PanelLost(f"the X server does not support OpenGL: {_text(error)}") from None
        return self._windows[0]

    def monitors(self) -> tuple[Monitor, ...]:
        """Return the active monitors, sorted from left to right."""
        return in_order([monitor for monitor, _ in self._pairs()])

    def fullscreen_window(self, monitor: Monitor, *, title: str, opengl: bool = True) -> Window:
        """Open a borderless window that fills a monitor; with `opengl`, make its context, shared with the
        root's, current. Raises PanelLost if the monitor is no longer connected, or the X server does not support
        OpenGL.
        """
        share = self.root.handle if opengl else None
        handles = {connected.connector: handle for connected, handle in self._pairs()}
        if monitor.connector not in handles:
            raise PanelLost(f"{monitor.connector} is no longer connected")
        _hints()
        if not opengl:
            glfw.window_hint(glfw.CLIENT_API, glfw.NO_API)
        handle = glfw.create_window(monitor.width_px, monitor.height_px, title, handles[monitor.connector], share)
        return self._adopt(handle, opengl=opengl)

    def poll(self) -> str:
        """Process X events, and return a description of any fault that makes the windows unusable, or ""."""
        glfw.poll_events()
        faults = self.faults + [fault for window in self._windows for fault in window.faults]
        return "; ".join(faults)

    def close_windows(self) -> None:
        """Close all windows except the hidden root window."""
        self._close_from(1)
        self.faults.clear()

    def close(self) -> None:
        """Close every window, including the hidden root window. May be called more than once."""
        self._close_from(0)

    def _close_from(self, first: int) -> None:
        for window in self._windows[first:]:
            if window.context is not None:
                window.context.release()
            glfw.destroy_window(window.handle)
        self._windows = self._windows[:first]

    def _adopt(self, handle: Any, *, opengl: bool = True) -> Window:
        if opengl:
            glfw.make_context_current(handle)
        window = Window(handle, _attach() if opengl else None)

        def closed(_handle: Any) -> None:
            window.faults.append("a panel's window was closed")

        def exposed(_handle: Any) -> None:
            window.exposed = True

        glfw.set_window_close_callback(handle, closed)
        glfw.set_window_refresh_callback(handle, exposed)
        glfw.set_input_mode(handle, glfw.CURSOR, glfw.CURSOR_HIDDEN)
        self._windows.append(window)
        return window

    def output_state(self, connector: str) -> xlib.OutputState | None:
        """Return the mode and monitor of an output such as `DP-1`, or None if it is off or disconnected."""
        output = self._outputs.get(connector)
        return xlib.output_state(x_display(), output) if output else None

    def window_state(self, window: Window) -> tuple[bool, Rectangle] | None:
        """Return whether a window is mapped, and its region of the X screen, or None if it was destroyed."""
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
            identity = edid.parse(state.edid) if state else None
            monitor = Monitor(
                connector=connector,
                serial=identity.serial if identity else "",
                model=" ".join(part for part in (identity.maker, identity.name) if part) if identity else "",
                x_px=x_px,
                y_px=y_px,
                width_px=mode.size.width,
                height_px=mode.size.height,
                refresh_hz=state.refresh_hz if state else 0.0,  # GLFW rounds the rate to an integer
                has_gamma=_has_gamma(handle),
            )
            pairs.append((monitor, handle))
        return pairs

    def _monitor_changed(self, handle: Any, what: int) -> None:
        name = glfw.get_monitor_name(handle).decode()
        self.faults.append(f"{name} was {'connected' if what == glfw.CONNECTED else 'disconnected'}")

    @property
    def has_windows(self) -> bool:
        """True if any window other than the hidden root window is open."""
        return len(self._windows) > 1


def _has_gamma(monitor: Any) -> bool:
    """Return True if the X server changes grey levels by more than an 8-bit level, as night lights do."""
    try:
        ramp = glfw.get_gamma_ramp(monitor)
    except glfw.GLFWError:  # the driver has no table
        return False
    levels = np.array([ramp.red, ramp.green, ramp.blue])
    return bool(levels.any() and not np.allclose(levels, np.linspace(0, 1, levels.shape[1]), rtol=0, atol=1 / 255))


def x_display() -> int:
    """Return a pointer to GLFW's connection to the X server, an Xlib `Display`."""
    return int(glfw.get_x11_display())


def connected_monitors() -> tuple[Monitor, ...]:
    """Return the active monitors, left to right. Raises PanelLost without any, or MissingPart."""
    monitors = Display().monitors()
    if not monitors:
        raise PanelLost("no monitor is active on the X server")
    return monitors


def _attach() -> moderngl.Context:
    settings: dict[str, Any] = {"context": _Functions()}
    return moderngl.create_context(require=MINIMUM_VERSION, **settings)


def _hints() -> None:
    glfw.default_window_hints()
    glfw.window_hint_string(glfw.X11_CLASS_NAME, "phasestack")  # by which the scene `window` leaves them out
    glfw.window_hint_string(glfw.X11_INSTANCE_NAME, "phasestack")
    # Like the offscreen context, the windows use EGL, because a thread cannot switch between GLX and EGL contexts.
    glfw.window_hint(glfw.CONTEXT_CREATION_API, glfw.EGL_CONTEXT_API)
    glfw.window_hint(glfw.CONTEXT_VERSION_MAJOR, MINIMUM_VERSION // 100)
    glfw.window_hint(glfw.CONTEXT_VERSION_MINOR, MINIMUM_VERSION // 10 % 10)
    glfw.window_hint(glfw.OPENGL_PROFILE, glfw.OPENGL_CORE_PROFILE)
    glfw.window_hint(glfw.CONTEXT_ROBUSTNESS, glfw.LOSE_CONTEXT_ON_RESET)
    glfw.window_hint(glfw.AUTO_ICONIFY, False)


def _text(error: Exception) -> str:
    return re.sub(r"^\(\d+\) b?['\"]?(.*?)['\"]?$", r"\1", str(error)) or type(error).__name__
