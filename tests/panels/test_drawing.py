"""Tests how windows are opened, copied to and released on a real X server, partly in simulated time."""

from __future__ import annotations

import ctypes
import gc
import os
import resource
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from runtime.clock import SimulatedClock
from runtime.config import PanelSettings
from runtime.optics.malus import rest_code
from runtime.optics.rect import PixelRect
from runtime.panels import drawing, xlib
from runtime.panels.display import connected_monitors, gl_function, glfw, x_display
from runtime.panels.presentation import Painter
from runtime.panels.shared_picture import NotShared, SharedPicture
from runtime.records import PanelFrame
from tests.panels import presentation_table as table
from tests.panels.edids import block
from tests.panels.test_windows import OPENGL, PROCESSOR
from tests.panels.xserver import HEIGHT_PX, WIDTH_PX, XServer
from tests.waiting import eventually

pytestmark = pytest.mark.windows
PANELS = tuple(PanelSettings(connector=f"DUMMY{n}") for n in range(3))
MEMORY = Path("/proc/sysvipc/shm")  # a line for each segment of shared memory


def ours() -> list[tuple[str, int]]:
    """Permissions and sizes of the segments that this process has made."""
    rows = [row.split() for row in MEMORY.read_text().splitlines()]
    return [(mode[-3:], int(size)) for _, _, mode, size, maker, *_ in rows if maker == str(os.getpid())]


def segments() -> list[str]:
    """Permissions of this process's memory shared for pictures of 320x180."""
    return [mode for mode, size in ours() if size == 128 + 4 * WIDTH_PX * HEIGHT_PX]


def class_of(x: XServer, window: Any) -> list[bytes | None]:
    """Name and class of a GLFW window, as a window manager reads them."""
    names = (ctypes.c_char_p * 2)()
    x.do_to_window("XGetClassHint", glfw.get_x11_window(window), names)
    return list(names)


def objects(*kinds: str) -> list[tuple[str, int]]:
    """OpenGL objects of the current context."""
    gl = ctypes.CDLL("libGL.so.1")
    return [(kind, n) for kind in kinds for n in range(1, 300) if getattr(gl, f"glIs{kind}")(n)]


def used_bytes() -> int:
    """Memory in use that was allocated by malloc, as Xlib does."""
    gc.collect()
    mallinfo2 = ctypes.CDLL(None).mallinfo2
    mallinfo2.restype = type("Mallinfo2", (ctypes.Structure,), {"_fields_": [("all", ctypes.c_size_t * 10)]})
    return int(mallinfo2().all[7])


@PROCESSOR
def test_only_changed_or_exposed_pictures_are_copied_and_lit_when_copied(
    x: XServer, opened: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Copying takes 100 ns a picture in simulated time, at first 500."""
    clock, done, numbers = SimulatedClock(), list[Any](), dict[SharedPicture, int]()
    put, finish, flush = SharedPicture.put, drawing.finish, drawing.flush

    def noted(picture: SharedPicture, part: PixelRect | None = None) -> None:
        done.append((numbers.setdefault(picture, len(numbers)), part))
        put(picture, part)

    def waited(connection: int) -> None:
        finish(connection)
        waits = [at for at, what in enumerate(done) if what == "waited"]
        copies = len(done) - (waits[-1] + 1 if waits else 0)
        clock.advance_ns(copies * (500 if len(waits) < 2 else 100))
        done.append("waited")

    monkeypatch.setattr(SharedPicture, "put", noted)
    monkeypatch.setattr(drawing, "finish", waited)
    monkeypatch.setattr(drawing, "flush", lambda connection: (done.append("sent"), flush(connection)))
    sink = opened(*PANELS, clock=clock)
    windows = sink._windows
    assert not x.screenshot().any() and segments() == ["600"] * 3
    assert (sum(what[1:] == (None,) for what in done), done.count("waited")) == (12, 8) and windows.show_ns == 300
    for window in windows.windows:
        window.exposed = False  # as X has told on mapping them
    layers = np.full((3, HEIGHT_PX, WIDTH_PX, 4), rest_code(3), np.uint8)
    whole, part = PixelRect(0, 0, WIDTH_PX, HEIGHT_PX), PixelRect(6, 2, 25, 15)  # and what interpolation reaches
    for number, shown, lit_ns in (
        (1, [(0, whole), (1, whole), (2, whole)], (100, 300)),
        (2, [(1, part), (2, None)], (100, 200)),
        (2, [], (0, 0)),
    ):
        layers[1, 6:10, 10:20] = 255 if number == 2 else rest_code(3)
        windows.draw(PanelFrame(number, layers, number))
        if (2, None) in shown:
            assert not windows.damaged
            with x.covered(2):
                pass
            assert eventually(lambda: sink._display.poll() == "" and windows.damaged)
        done.clear()
        now_ns = clock.now_ns()
        assert windows.show(clock) == (now_ns + lit_ns[0], now_ns + lit_ns[1])
        assert done == [*shown, "sent"] and not windows.damaged
        assert eventually(lambda: np.array_equal(x.panel(1), layers[1, ..., :3]))
    sink.close()
    refusals = xlib.refusals()
    windows.abandon()
    assert segments() == [] and xlib.refusals() == refusals


@PROCESSOR
def test_without_shared_memory_everything_is_closed_and_opengl_draws(
    opened: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    open_ = SharedPicture._open

    def refused(picture: SharedPicture, *size_px: int) -> None:
        open_(picture, *size_px)
        if len(segments()) == 3:
            raise NotShared("the X server cannot reach this process's memory")

    monkeypatch.setattr(SharedPicture, "_open", refused)
    sink = opened(*PANELS)
    assert sink._windows.opengl and sink._windows.show_ns == 0
    assert len(sink._display._windows) == 4 and segments() == []


@OPENGL
def test_opengl_waits_for_the_first_blank_and_leaves_no_objects(
    opened: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    intervals, interval = list[int](), glfw.swap_interval
    monkeypatch.setattr(glfw, "swap_interval", lambda blanks: (intervals.append(blanks), interval(blanks)))
    sink = opened(*PANELS)
    windows, display = sink._windows, sink._display
    assert intervals == [1, 0, 0]
    windows.draw(table.ROWS["mixed"].frame())
    assert windows.show(SimpleNamespace(now_ns=iter((3, 5, 9)).__next__)) == (3, 9)
    assert gl_function("glGetGraphicsResetStatus") and gl_function("absent") == 0
    told = ctypes.c_int()
    ctypes.CDLL("libGL.so.1").glGetIntegerv(0x8256, ctypes.byref(told))
    assert told.value == 0x8252  # after a reset, the context is lost, and says so
    windows.release()
    for window in windows.windows:
        window.make_current()
        assert objects("VertexArray") == []
    painters = iter((Painter, Painter))
    monkeypatch.setattr(drawing, "Painter", lambda *told: next(painters)(*told))
    how = {"layer_px": (WIDTH_PX, HEIGHT_PX), "clock": SimulatedClock(), "on_processor": False}
    with pytest.raises(StopIteration):  # there is none for the last panel
        drawing.open_windows(display, PANELS, display.monitors(), **how)
    display.close_windows()
    display.root.make_current()
    assert objects("Texture", "Program", "Shader", "Buffer", "Framebuffer") == []
    kept = []
    for _ in range(4):  # at first, libraries are prepared, and other threads allocate now and then
        before = used_bytes()
        for _ in range(10):
            display.fullscreen_window(display.monitors()[0], title="")
            display.close_windows()
        kept.append(used_bytes() - before)
    assert min(kept) < 150_000  # the driver keeps 80 kB, and contexts kept by moderngl would be 130 kB


def test_windows_are_ours_stay_without_focus_and_hide_the_pointer(
    x: XServer, opened: Callable[..., Any], drawn_by: str
) -> None:
    sink = opened(*PANELS)
    display, root = sink._display, sink._display.root.handle
    assert class_of(x, root) == [b"phasestack"] * 2
    assert not glfw.get_window_attrib(root, glfw.VISIBLE)
    for handle in sink.window_handles:
        number = glfw.get_x11_window(handle)
        x.do_to_window("XSetInputFocus", number, 0, 0)
        assert class_of(x, handle) == [b"phasestack"] * 2
        assert eventually(lambda handle=handle: display.poll() == "" and glfw.get_window_attrib(handle, glfw.FOCUSED))
        assert glfw.get_window_attrib(handle, glfw.CLIENT_API) == {"opengl": 0x30001, "processor": 0}[drawn_by]
        assert glfw.get_input_mode(handle, glfw.CURSOR) == glfw.CURSOR_HIDDEN
    for change, told in ((x.unplug, "DUMMY1 was disconnected"), (x.plug, "DUMMY1 was connected")):
        assert display.has_windows == (change == x.unplug)
        change(1)
        assert eventually(lambda told=told: display.poll() == told)
        display.close_windows()
        assert display.poll() == ""
    for change, connected in ((x.unplug, 2), (x.plug, 3)):
        change(2)
        assert eventually(lambda connected=connected: len(connected_monitors()) == connected)
    number, names = glfw.get_x11_window(root), (ctypes.c_char_p * 2)()
    sink.close()
    drawing.finish(x_display())
    x.do_to_window("XGetClassHint", number, names)
    assert list(names) == [None] * 2  # not even the root window is left


@PROCESSOR
def test_pictures_and_questions_take_no_memory_for_good(x: XServer, opened: Callable[..., Any]) -> None:
    x.set_edid(0, block(serial_text="ONE"))
    sink = opened(*PANELS)
    place = x_display(), glfw.get_x11_window(sink.window_handles[0])
    kept = []
    for _ in range(4):  # at first, libraries are prepared, and other threads allocate now and then
        before = used_bytes()
        for _ in range(300):
            assert sink._display.output_state("DUMMY0")
            SharedPicture(*place, width_px=WIDTH_PX, height_px=HEIGHT_PX).close()
        kept.append(used_bytes() - before)
    assert min(kept) < 9000
    listed, refusals, limits = ours(), xlib.refusals(), resource.getrlimit(resource.RLIMIT_AS)
    in_use = 4096 * int(Path("/proc/self/statm").read_text().split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (in_use + (1 << 29), limits[1]))
    try:
        with pytest.raises(NotShared, match="no shared memory: Cannot allocate memory"):
            SharedPicture(*place, width_px=20000, height_px=20000)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limits)
    assert ours() == listed and xlib.refusals() == refusals
