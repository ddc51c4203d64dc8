"""Tests windows on three virtual monitors of a real X server, by screenshots."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from runtime.clock import SimulatedClock
from runtime.config import PanelSettings
from runtime.errors import PanelLost
from runtime.optics.alignment import align
from runtime.optics.presentation import shown_layers
from runtime.optics.stack import PanelStack
from runtime.panels import drawing
from runtime.panels.window import WindowPanels
from runtime.records import PanelFrame
from tests.panels.edids import block
from tests.panels.xserver import HEIGHT_PX, WIDTH_PX, XServer
from tests.waiting import eventually

pytestmark = pytest.mark.windows
STACK = PanelStack(0.5, 0.28, (-0.06, 0.0, 0.06), WIDTH_PX, HEIGHT_PX)


def picture(number: int, index: int) -> np.ndarray:
    """Layer that encodes its panel, frame and orientation: no rotation or mirroring looks alike."""
    layer = np.zeros((HEIGHT_PX, WIDTH_PX, 4), np.uint8)
    layer[..., 0] = np.linspace(0, 255, WIDTH_PX).astype(np.uint8)
    layer[..., 1] = np.linspace(0, 255, HEIGHT_PX).astype(np.uint8)[:, None]
    layer[..., 2] = 60 * index + number % 60
    return layer


def frame(number: int) -> PanelFrame:
    return PanelFrame(number, np.stack([picture(number, index) for index in range(3)]), number)


OPENGL = pytest.mark.parametrize("drawn_by", ["opengl"])
PROCESSOR = pytest.mark.parametrize("drawn_by", ["processor"])
BY_CONNECTOR = tuple(PanelSettings(connector=f"DUMMY{index}") for index in (2, 0, 1))


def shows(x: XServer, monitor: int, expected: np.ndarray) -> bool:
    return eventually(lambda: np.array_equal(x.panel(monitor), expected[..., :3]))


def test_panels_found_by_edid_serial_are_sent_corrected_pictures(x: XServer, opened: Callable[..., Any]) -> None:
    for index, serial in enumerate(("MIDDLE", "FRONT", "REAR")):
        x.set_edid(index, block(serial_text=serial))
    sink = opened(
        PanelSettings(edid_serial="REAR", rotation_deg=180),
        PanelSettings(edid_serial="MIDDLE", mirror="horizontal"),
        PanelSettings(edid_serial="FRONT", gamma=2.0),
    )
    assert [monitor.connector for monitor in sink.monitors] == ["DUMMY2", "DUMMY0", "DUMMY1"]
    assert sink.monitors[0].model == "EIZ CG2700X"
    sink.present(frame(3))
    assert shows(x, 2, picture(3, 0)[::-1, ::-1])
    assert shows(x, 0, picture(3, 1)[:, ::-1])
    expected = 255 * np.sqrt(picture(3, 2)[..., :3] / 255)
    assert eventually(lambda: np.abs(x.panel(1) - expected).max() <= 0.51)


def presents(sink: WindowPanels, number: int, *, unchanged: bool = False) -> bool:
    try:
        return sink.present(frame(number), unchanged=unchanged).number == number
    except PanelLost:
        return False


# A solution that is aligned to where the eyes are now.

HEAD = np.array([[0.6, -0.031, 0.0], [0.6, 0.031, 0.0]])


def moved(number: int, *, flatness: float = 0.0) -> PanelFrame:
    """One solution, seen from elsewhere in every frame."""
    eyes_m = HEAD + number * np.array([0.01, 0.008, -0.004])
    solved = np.stack([picture(7, index) for index in range(3)])
    matrices = align(STACK, solved_for_m=HEAD, eyes_m=eyes_m).solved_from_shown
    return PanelFrame(number, solved, 7, matrices, solved[::-1], 7, flatness)


def test_the_aligned_picture_is_on_all_panels_in_the_same_frame(x: XServer, opened: Callable[..., Any]) -> None:
    sink = opened(*BY_CONNECTOR)
    for number in range(6):
        frame = moved(number, flatness=0.2 * number)
        assert sink.present(frame).number == number
        expected = shown_layers(frame)[..., :3].astype(int)

        def difference(expected: NDArray[np.int64] = expected) -> np.ndarray:
            return np.abs(np.stack(x.panels())[[2, 0, 1]] - expected)

        assert eventually(lambda: difference().max() <= 2)
        assert (difference() <= 1).mean() >= 0.999


@OPENGL
def test_the_pacer_gets_the_time_and_period_of_vertical_blanks(opened: Callable[..., Any]) -> None:
    sink = opened(*BY_CONNECTOR)
    assert sink.period_ns == pytest.approx(1e9 / 60, rel=1e-3)
    first, second = sink.present(moved(0)), sink.present(moved(1))
    assert first.vblank_ns < second.vblank_ns <= second.present_ns
    assert second.vblank_ns == pytest.approx(second.present_ns - 1e6 * second.skew_ms, abs=2)
    assert sink.present(moved(1), unchanged=True).vblank_ns is None  # no swap


@OPENGL  # nothing can fail on the processor
def test_a_fault_while_drawing_leaves_the_new_frame_on_no_panel(
    x: XServer, opened: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    sink = opened(*BY_CONNECTOR)
    assert presents(sink, 0)
    lost = ctypes.CFUNCTYPE(ctypes.c_uint)(lambda: 0x8253)  # no software driver ever loses one
    with monkeypatch.context() as patch:
        patch.setattr(drawing, "gl_function", lambda _: ctypes.cast(lost, ctypes.c_void_p).value)
        with pytest.raises(PanelLost, match=r"context of panel 0 failed: the driver reset the GPU \(0x8253\)"):
            sink.present(frame(1))
    for index, monitor in enumerate((2, 0, 1)):
        assert not np.array_equal(x.panel(monitor), picture(1, index)[..., :3])
    assert eventually(lambda: presents(sink, 2))
    monkeypatch.setattr(drawing, "gl_function", lambda _: 0)  # not every driver can be asked
    assert presents(sink, 3)


def test_a_lost_monitor_is_named_and_used_again_for_unchanged_frames(x: XServer, opened: Callable[..., Any]) -> None:
    sink = opened(*BY_CONNECTOR)
    sink.present(frame(0))
    assert sink.present(frame(1), unchanged=True).number == 1
    assert shows(x, 2, picture(0, 0))
    x.unplug(1)
    with pytest.raises(PanelLost, match="DUMMY1"):
        for number in range(2, 50):
            sink.present(frame(number), unchanged=True)
    with pytest.raises(PanelLost, match="DUMMY1"):
        sink.present(frame(50))
    x.plug(1)
    assert eventually(lambda: presents(sink, 50, unchanged=True))
    assert shows(x, 2, picture(50, 0)) and shows(x, 1, picture(50, 2))


@PROCESSOR
def test_a_picture_that_another_window_covered_is_shown_again(x: XServer, opened: Callable[..., Any]) -> None:
    sink = opened(*BY_CONNECTOR)
    assert presents(sink, 0)
    with x.covered(2):
        assert eventually(lambda: not np.array_equal(x.panel(2), picture(0, 0)[..., :3]))

    def is_shown_again() -> bool:  # without a lost panel
        return sink.present(frame(0), unchanged=True).number == 0 and np.array_equal(x.panel(2), picture(0, 0)[..., :3])

    assert eventually(is_shown_again)


@PROCESSOR
def test_a_frame_drawn_early_is_shown_when_it_is_due(x: XServer, opened: Callable[..., Any]) -> None:
    sink, due_ns = opened(*BY_CONNECTOR, clock=SimulatedClock()), 200_000_000
    first = sink.present(frame(0), due_ns=due_ns)
    assert (first.present_ns, first.held_ns) == (due_ns, due_ns) and shows(x, 2, picture(0, 0))
    assert sink.present(frame(1), due_ns=due_ns).held_ns == 0
    same = sink.present(frame(1), unchanged=True, due_ns=2 * due_ns)
    assert (same.present_ns, same.held_ns) == (2 * due_ns, None)


@pytest.mark.skipif(os.getuid() != 0 or shutil.which("unshare") is None, reason="needs root and unshare")
def test_without_memory_shared_with_the_x_server_opengl_draws(x: XServer) -> None:
    """As in a container with an IPC namespace of its own."""
    script = """
from tests.panels.test_windows import BY_CONNECTOR, frame
from runtime.clock import MonotonicClock
from runtime.panels.window import WindowPanels
from runtime.support.gl import offscreen_context

sink = WindowPanels(BY_CONNECTOR, (320, 180), MonotonicClock(), offscreen_context(), on_processor=True)
print(type(sink._windows).__name__, sink.present(frame(3)).number)
"""
    done = subprocess.run(
        ["unshare", "--ipc", sys.executable, "-c", script],
        cwd=Path(__file__).parents[2], capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.stdout == "ShaderWindows 3\n", done.stderr
    assert "the X server cannot reach this process's memory" in done.stderr
    assert done.stderr.count("refused a request") == 1, done.stderr
