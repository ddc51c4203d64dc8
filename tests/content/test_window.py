"""Tests `scene = "window"` with windows on a virtual X server."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from ctypes.util import find_library
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from runtime.config import ContentSettings, StackGeometry
from runtime.content.registry import open_content
from runtime.content.window import Place, place_of
from runtime.errors import ContentFailure, InputError
from runtime.optics.stack import PanelStack
from runtime.plan.drawing import raster_views
from tests.waiting import eventually

STACK = replace(StackGeometry().stack(), width_px=64, height_px=36)
LARGE = replace(STACK, width_px=256, height_px=144)
EYES = np.array([[0.6, -0.03, 0.0], [0.6, 0.03, 0.0]])
SHOWS_HALVES = (  # a window whose left half has one colour and whose right half another
    "import sys, tkinter; root = tkinter.Tk(); root.title(sys.argv[1]); root.geometry(sys.argv[2])\n"
    "for n, colour in enumerate(sys.argv[3:5]):\n"
    "    tkinter.Frame(root, bg=colour).place(relx=n / 2, rely=0, relwidth=0.5, relheight=1)\n"
    "root.mainloop()"
)
HANGS = (  # a window whose program does nothing from SIGUSR1 to SIGUSR2
    "import glfw, signal; signal.signal(signal.SIGUSR1, lambda *_: signal.sigwait({signal.SIGUSR2})); glfw.init()\n"
    "signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGUSR2}); glfw.window_hint(glfw.CLIENT_API, glfw.NO_API)\n"
    "glfw.create_window(160, 90, 'stereo', None, None)\nwhile True: glfw.wait_events_timeout(0.1)"
)
LISTED = """
xwininfo: Window id: 0x50e (the root window) (has no name)

     3 children:
     0x200009 "A stereo player": ("player" "Player")  640x360+0+0  +20+-30
        1 child:
        0x20000a (has no name): ()  640x360+0+0  +20+-30
     0x400009 "phasestack 1": ("phasestack" "phasestack")  1920x1080+0+0  +0+0
     0x600001 "player": ("tiny" "Tiny")  1x1+-1+-1  +-1+-1
     0x700001 (has no name): ()  1290x430+0+0  +0+0
        1 child:
        0x70000a "PyMOL": ("PyMOL" "PyMOL")  1280x400+5+25  +5+25
           3 children:
           0x700013 "PyMOL": ("PyMOL" "PyMOL")  1280x22+0+0  +5+25
           0x700006 "PyMOL": ("PyMOL" "PyMOL")  1280x378+0+22  +5+47
           0x70000c "PyMOL": ("PyMOL" "PyMOL")  100x30+0+0  +5+25
"""

needs_x = pytest.mark.skipif(
    shutil.which("Xvfb") is None or shutil.which("xwininfo") is None or find_spec("_tkinter") is None,
    reason="needs Xvfb, xwininfo and tkinter",
)


@pytest.fixture
def display() -> Iterator[str]:
    reading, writing = os.pipe()
    command = ["Xvfb", "-displayfd", str(writing), "-screen", "0", "400x300x24"]
    with subprocess.Popen(command, pass_fds=(writing,), stderr=subprocess.DEVNULL) as server:
        os.close(writing)
        with os.fdopen(reading, "rb") as told:
            yield f":{told.readline().decode().strip()}"
        server.kill()


def window(
    display: str, title: str, geometry: str, *colours: str, script: str = SHOWS_HALVES
) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-c", script, title, geometry, *colours]
    return subprocess.Popen(command, env=os.environ | {"DISPLAY": display})


def opened(**options: Any) -> Any:
    settings = ContentSettings(scene="window", layout="side-by-side", options=options)
    return open_content(settings, STACK, None)


def shows(source: Any, left: tuple[int, ...], right: tuple[int, ...]) -> bool:
    views = raster_views(EYES, STACK.panel(1))
    try:
        source.expect(views, time_ns=0)
        pictures = [source.render(view, time_ns=0)[18, 32, :3].tolist() for view in views]
    except ContentFailure:
        return False
    return pictures == [list(left), list(right)]


@needs_x
def test_each_eye_sees_its_half_of_the_window(display: str) -> None:
    source = opened(title="stereo", display=display)
    assert eventually(lambda: "no window has this title" in source.problem)
    first = window(display, "A Stereo window", "160x90+100+50", "#ff0000", "#0000ff")
    assert eventually(lambda: shows(source, (255, 0, 0), (0, 0, 255)) and source.problem == "")
    first.kill()
    first.wait()
    assert eventually(lambda: "no window has this title" in source.problem)
    assert shows(source, (255, 0, 0), (0, 0, 255))  # the last picture stays
    second = window(display, "stereo again", "300x200+10+10", "#00ff00", "#ffff00")  # larger, elsewhere
    assert eventually(lambda: shows(source, (0, 255, 0), (255, 255, 0)) and source.problem == "")
    second.kill()
    second.wait()
    source.close()


@needs_x
def test_a_picture_that_does_not_change_is_not_solved_again(display: str) -> None:
    source = opened(region=(0, 0, 64, 36), display=display)
    assert eventually(lambda: source.revision(time_ns=0) == 1)
    assert not eventually(lambda: source.revision(time_ns=0) > 1, within_s=1.0) and source.problem == ""
    source.close()


@needs_x
def test_a_command_has_its_own_screen_and_ends_with_the_scene(tmp_path: Path) -> None:
    told = str(tmp_path / "pid")
    script = f"import os; open({told!r}, 'w').write(str(os.getpid()))\n" + SHOWS_HALVES
    command = [sys.executable, "-c", script, "any", "200x100+0+0", "#00ffff", "#ff00ff"]
    source = opened(command=command, size_px=(200, 100))
    assert eventually(lambda: shows(source, (0, 255, 255), (255, 0, 255)))
    first = int(Path(told).read_text())
    os.kill(first, signal.SIGKILL)
    assert eventually(lambda: "ended with exit status -9" in source.problem)
    assert eventually(lambda: shows(source, (0, 255, 255), (255, 0, 255)) and source.problem == "")
    last = int(Path(told).read_text())
    source.close()
    assert last != first and eventually(lambda: not Path(f"/proc/{last}").exists())


@needs_x
def test_an_x_server_that_ends_is_told(display: str) -> None:
    source = opened(title="any", display=":4711")
    assert eventually(lambda: "the X server :4711 cannot be used" in source.problem)
    source.close()


needs_a_mouse = pytest.mark.skipif(shutil.which("xdotool") is None, reason="needs xdotool")


def mouse(display: str, *action: str) -> None:
    """Move or press the mouse. Xvfb refuses connections for a moment after its last client has left."""
    environment = os.environ | {"DISPLAY": display}
    assert eventually(lambda: subprocess.run(["xdotool", *action], env=environment).returncode == 0)


def tips(source: Any) -> list[list[float]]:
    """Place of the arrow's tip in each view that shows it, as fractions of its width and height."""
    try:
        pictures = [picture.min(2).astype(int) for picture in views_of(source, LARGE)]
    except ContentFailure:
        return []
    rows_columns = [np.argwhere(picture > 60)[0] for picture in pictures if (picture > 60).any()]
    return [[column / LARGE.width_px, row / LARGE.height_px] for row, column in rows_columns]


@needs_x
@needs_a_mouse
def test_the_mouse_pointer_is_at_the_screens_depth(display: str) -> None:
    shown = window(display, "stereo", "320x90+20+30", "#000000", "#000000")
    source = opened(title="stereo", display=display)
    assert eventually(lambda: source.revision(time_ns=0) > 0)
    for x in (60, 220):  # the same place of the left and of the right half
        mouse(display, "mousemove", "380", "280")  # outside the window
        assert eventually(lambda: source.revision(time_ns=0) > 0 and tips(source) == [])
        mouse(display, "mousemove", str(x), "75")
        assert eventually(lambda: len(tips(source)) == 2)
        np.testing.assert_allclose(tips(source), [[0.25, 0.5]] * 2, atol=0.08)
    shown.kill()
    shown.wait()
    source.close()


@needs_x
@needs_a_mouse
def test_a_window_is_picked_by_a_click(display: str) -> None:
    both = (
        window(display, "one", "120x90+0+0", "#ff0000", "#0000ff"),
        window(display, "two", "120x90+200+0", "#00ff00", "#ffff00"),
    )
    source = opened(pick=True, pointer=False, display=display)
    assert eventually(lambda: source.problem == "click on the window to show")

    def is_picked() -> bool:
        mouse(display, "mousemove", "260", "45", "mousedown", "1", "sleep", "0.1", "mouseup", "1")
        return shows(source, (0, 255, 0), (255, 255, 0))

    assert eventually(is_picked) and source.problem == ""
    for one in both:
        one.kill()
        one.wait()
    assert eventually(lambda: source.problem == "click on the window to show")
    source.close()


def in_window(display: str, title: str, action: str) -> None:
    subprocess.run(["xdotool", "search", "--name", title, action], env=os.environ | {"DISPLAY": display}, check=True)


@needs_x
@needs_a_mouse
def test_a_hidden_window_is_told_and_comes_back(display: str) -> None:
    shown = window(display, "stereo", "160x90+0+0", "#ff0000", "#0000ff")
    source = opened(title="stereo", display=display)
    assert eventually(lambda: shows(source, (255, 0, 0), (0, 0, 255)))
    in_window(display, "stereo", "windowunmap")
    assert eventually(lambda: "stereo: is hidden" in source.problem)
    in_window(display, "stereo", "windowmap")
    assert eventually(lambda: source.problem == "")
    shown.kill()
    shown.wait()
    source.close()


needs_processes = pytest.mark.skipif(find_library("xcb-res") is None, reason="needs libxcb-res")


@needs_x
@pytest.mark.parametrize(
    ("script", "right", "hang", "go_on"),
    [
        pytest.param(SHOWS_HALVES, (0, 0, 255), signal.SIGSTOP, signal.SIGCONT, marks=needs_processes),
        (HANGS, (0, 0, 0), signal.SIGUSR1, signal.SIGUSR2),
    ],
)
def test_a_program_that_hangs_is_told_and_keeps_its_picture(
    display: str, script: str, right: tuple[int, ...], hang: signal.Signals, go_on: signal.Signals
) -> None:
    shown = window(display, "stereo", "160x90+0+0", "#000000", "#0000ff", script=script)
    source = opened(title="stereo", display=display)
    assert eventually(lambda: shows(source, (0, 0, 0), right) and source.problem == "")
    shown.send_signal(hang)
    assert eventually(lambda: source.problem == "stereo: the program does not respond")
    assert shows(source, (0, 0, 0), right)
    shown.send_signal(go_on)
    assert eventually(lambda: source.problem == "")
    shown.kill()
    shown.wait()
    source.close()


@needs_x
@pytest.mark.skipif(find_library("xcb-composite") is None, reason="needs libxcb-composite")
def test_a_covered_window_is_shown_and_a_part_of_it(display: str) -> None:
    under = window(display, "under", "160x90+40+30", "#ff0000", "#0000ff")
    source = opened(title="under", region=(40, 10, 80, 60), display=display)
    assert eventually(lambda: shows(source, (255, 0, 0), (0, 0, 255)))
    source.close()
    over = window(display, "over", "400x300+0+0", "#808080", "#808080")
    screen = opened(region=(0, 0, 400, 300), display=display)
    assert eventually(lambda: shows(screen, (128,) * 3, (128,) * 3))
    screen.close()
    source = opened(title="under", region=(40, 10, 80, 60), display=display)
    assert eventually(lambda: shows(source, (255, 0, 0), (0, 0, 255)))
    for one in (under, over):
        one.kill()
        one.wait()
    source.close()


def views_of(source: Any, stack: PanelStack) -> list[np.ndarray]:
    views = raster_views(EYES, stack.panel(1))
    source.expect(views, time_ns=0)
    return [source.render(view, time_ns=0)[..., :3].copy() for view in views]


@pytest.mark.skipif(shutil.which("Xvfb") is None or shutil.which("mpv") is None, reason="needs Xvfb and mpv")
@pytest.mark.parametrize("layout", ["side-by-side", "top-bottom"])
def test_mpv_shows_each_eye_its_half_to_the_pixel(tmp_path: Path, layout: str) -> None:
    picture = np.random.default_rng(0).integers(0, 256, (96, 160, 3), np.uint8)
    cv2.imwrite(str(tmp_path / "picture.png"), picture[..., ::-1])
    halves = np.split(picture, 2, axis=1 if layout == "side-by-side" else 0)
    height, width = halves[0].shape[:2]
    stack = replace(STACK, width_px=width, height_px=height, width_m=width / 400, height_m=height / 400)
    command = ["mpv", "--no-config", "--vo=x11", "--no-osc", "--really-quiet", "--fs", "--image-display-duration=inf"]
    options = {"command": [*command, str(tmp_path / "picture.png")], "size_px": (160, 96), "pointer": False}
    source = open_content(ContentSettings(scene="window", layout=layout, options=options), stack, None)

    def is_exact() -> bool:
        with suppress(ContentFailure):
            return np.array_equal(views_of(source, stack), halves)
        return False

    assert eventually(is_exact) and source.problem == ""
    source.close()


@needs_x
@pytest.mark.skipif(shutil.which("pymol") is None, reason="needs PyMOL")
def test_pymol_shows_near_atoms_in_front_and_no_menu(display: str, tmp_path: Path) -> None:
    (tmp_path / "atoms.pml").write_text(
        "pseudoatom near, pos=[0, 5, 10], color=red\npseudoatom far, pos=[0, -5, -10], color=blue\nshow spheres\n"
        "bg_color white\nset depth_cue, 0\nset internal_feedback, 0\nstereo sidebyside\nreset\n"
    )
    command = ["pymol", "-q", "-x", "-i", "-W", "380", "-H", "200", str(tmp_path / "atoms.pml")]
    environment = os.environ | {"DISPLAY": display, "PATH": "/usr/bin:/bin"}  # Debian's script runs Debian's Python
    pymol = subprocess.Popen(command, env=environment, start_new_session=True)
    source = opened(title="pymol", display=display, pointer=False)

    def offsets() -> list[float]:
        """How far each ball is to the right in the left eye's view, in pixels."""
        try:
            pair = [picture.astype(int) for picture in views_of(source, LARGE)]
        except ContentFailure:
            return []
        places = [
            [np.argwhere(eye[..., own] - eye[..., other] > 60)[:, 1] for eye in pair] for own, other in ((0, 2), (2, 0))
        ]
        return [left.mean() - right.mean() for left, right in places if len(left) and len(right)]

    try:
        assert eventually(lambda: len(offsets()) == 2)
        near, far = offsets()
        assert near > 0.5 and far < -0.5
        assert views_of(source, LARGE)[0][4:16, 100:156].min() == 255  # no menu, which is grey with black letters
    finally:
        source.close()
        os.killpg(pymol.pid, signal.SIGKILL)
        pymol.wait()


def test_the_largest_window_with_the_title_or_class_is_found() -> None:
    assert place_of("PLAYER", LISTED) == Place(20, -30, 640, 360, 0x200009)
    assert place_of("Tiny", LISTED) == Place(-1, -1, 1, 1, 0x600001)
    assert place_of("nothing", LISTED) is None


@pytest.mark.parametrize("window", ["pymol", 0x70000A, 0x700001])
def test_menus_and_frames_around_the_drawing_area_are_left_out(window: str | int) -> None:
    assert place_of(window, LISTED) == Place(5, 47, 1280, 378, 0x700006)


@needs_x
def test_our_own_panels_are_never_found(display: str) -> None:
    panel = (
        "import glfw, time; from runtime.panels import display; glfw.init(); display._hints()\n"
        "glfw.window_hint(glfw.CLIENT_API, glfw.NO_API); glfw.create_window(200, 100, 'panel 1', None, None)\n"
        "print('open', flush=True); time.sleep(60)"
    )
    command, environment = [sys.executable, "-c", panel], os.environ | {"DISPLAY": display}
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stdout.readline() == b"open\n"
        listed = subprocess.run(["xwininfo", "-root", "-tree", "-display", display], capture_output=True, text=True)
        process.kill()
    assert '"panel 1": ("phasestack" "phasestack")' in listed.stdout
    assert place_of("panel", listed.stdout) is None and place_of("phasestack", LISTED) is None


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ({}, "set one of title, pick, region and command"),
        ({"title": "a", "pick": True}, "set one of title, pick, region and command"),
        ({"region": (0, 0, 0, 10)}, "region: must be left, top, width, height"),
    ],
)
def test_wrong_options_are_one_line(options: dict, why: str) -> None:
    with pytest.raises(InputError, match=why):
        opened(**options)
