"""GLFW on X11: monitors, and windows whose GL contexts share one root's objects. Main thread only."""

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

glfw: Any = _glfw  # its stubs are wrong about bytes, None and pointers

# By default the binding turns errors into warnings; here every error is an exception.
glfw.ERROR_REPORTING = "exception"


@cache
def gl_function(name: str) -> int:
    """Return the address of an OpenGL function, which is the same in all contexts, or 0 if it is missing.

    The result is cached, because moderngl keeps references to all of them, 20 KiB per context.
    """
    return int(glfw.get_proc_address(name) or 0)


class WindowContext:
    """Adapts a GLFW window for moderngl: loads functions and makes the context current."""

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
        """Do nothing: the window owns its context."""


@dataclass(eq=False)
class Window:
    """A GLFW window and its moderngl context."""

    handle: Any
    context: moderngl.Context
    faults: list[str] = field(default_factory=list)  # faults reported by its callback

    def make_current(self) -> None:
        """Make its context current on this thread."""
        glfw.make_context_current(self.handle)


watch: xlib.ServerWatch | None = None  # watches the process's connection


def _connect() -> None:
    """Connect GLFW to the X server for the lifetime of the process. Raises PanelLost, MissingPart.

    When the panels lose their contexts, a drawing thread may still have a context of the same EGL display current. If
    GLFW then closed the display, Mesa would use freed memory.
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
        raise PanelLost(f"no X server: {_text(error)} (DISPLAY and XAUTHORITY select it)") from None
    if glfw.get_platform() != glfw.PLATFORM_X11:
        raise MissingPart("GLFW runs without X11, but only on X11 can a window be placed on a chosen monitor")
    xlib.take_over_errors()
    watch = xlib.ServerWatch(_pointer())


class Display:
    """Windows on the X server, including a hidden root window whose GL objects all others share.

    No window outlives `close`. If the X server dies, the process ends (see `xlib.take_over_errors`).
    """

    def __init__(self) -> None:
        """Connect. Raises PanelLost (no X server or no access; may be temporary), MissingPart (no X11 library)."""
        self.faults: list[str] = []
        self._windows: list[Window] = []
        self._outputs: dict[str, int] = {}
        _connect()
        glfw.set_monitor_callback(self._monitor_changed)

    @property
    def root(self) -> Window:
        """Return the hidden window. It is created on first use, because listing monitors needs no OpenGL.

        Raises PanelLost if the X server has no OpenGL.
        """
        if not self._windows:
            _hints()
            glfw.window_hint(glfw.VISIBLE, False)
            try:
                self._adopt(glfw.create_window(16, 16, "phasestack", None, None))
            except glfw.GLFWError as error:
                raise PanelLost(f"no OpenGL on the X server: {_text(error)}") from None
        return self._windows[0]

    def monitors(self) -> tuple[Monitor, ...]:
        """Return the active monitors, from left to right."""
        return in_order([monitor for monitor, _ in self._pairs()])

    def fullscreen_window(self, monitor: Monitor, *, title: str) -> Window:
        """Open a borderless window that fills a monitor, and make its context current. Raises PanelLost."""
        share = self.root.handle
        handles = {connected.connector: handle for connected, handle in self._pairs()}
        if monitor.connector not in handles:
            raise PanelLost(f"{monitor.connector} is no longer connected")
        glfw.window_hint(glfw.VISIBLE, True)
        handle = glfw.create_window(monitor.width_px, monitor.height_px, title, handles[monitor.connector], share)
        return self._adopt(handle)

    def poll(self) -> str:
        """Process X events. Returns any faults that make the windows useless, or an empty string."""
        glfw.poll_events()
        faults = self.faults + [fault for window in self._windows for fault in window.faults]
        return "; ".join(faults)

    def close_windows(self) -> None:
        """Close all windows except the root."""
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
        """Return the current mode and monitor of an output, or None if it is off or disconnected."""
        output = self._outputs.get(connector)
        return xlib.output_state(_pointer(), output) if output else None

    def window_state(self, window: Window) -> tuple[bool, Rectangle] | None:
        """Return whether a window and its ancestors are mapped, and its position; None if it was destroyed."""
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
            # GLFW rounds the rate to a whole number.
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
        """Return True if there are windows other than the hidden root."""
        return len(self._windows) > 1


def connected_monitors() -> tuple[Monitor, ...]:
    """Return the active monitors, left to right. Raises PanelLost (no X server or monitor), MissingPart."""
    display = Display()
    try:
        monitors = display.monitors()
    finally:
        display.close()
    if not monitors:
        raise PanelLost("the X server has no active monitor")
    return monitors


def _attach(handle: Any) -> moderngl.Context:
    settings: dict[str, Any] = {"context": WindowContext(handle)}
    return moderngl.create_context(require=MINIMUM_VERSION, **settings)


def _hints() -> None:
    glfw.default_window_hints()
    # EGL, as for the offscreen context: a thread can't switch between GLX and EGL contexts.
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
