"""The whole loop with the OpenGL backend: solver and panels share textures, and only the network's raster crosses."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from runtime.clock import NS_PER_S
from runtime.model.gl.state import GlState
from runtime.model.reprojection import NEUTRAL
from runtime.optics.alignment import shown_layers
from runtime.panels.display import glfw
from runtime.records import Solution
from runtime.support.gl_sharing import LayerTextures, lies_in
from tests.daemon.rig import Rig
from tests.panels import xserver
from tests.support.gl_calls import Counted
from tests.waiting import eventually

MODEL = {"backend": "gl"}
HELD = {"hold_s": 60.0}  # a machine too busy to see the viewer draws no flat picture
PANELS = [{"connector": f"DUMMY{index}"} for index in range(3)]


@pytest.fixture(params=["offscreen", "windows"])
def kind(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[xserver.XServer]:
    made = xserver.start_or_skip(tmp_path_factory.mktemp("xorg"))
    yield made
    made.stop()


@pytest.fixture
def outputs(kind: str, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """The settings' tables that the kind of panels needs."""
    if kind == "offscreen":
        return {}
    screen = request.getfixturevalue("server")
    monkeypatch.setenv("DISPLAY", screen.name)
    return on_windows()


def on_windows() -> dict[str, Any]:
    return {
        "stack": {"width_px": xserver.WIDTH_PX, "height_px": xserver.HEIGHT_PX},
        "output": {"kind": "windows", "panels": PANELS},
    }


class Crossing:
    """What crosses in the driver's functions, and what may: the network's raster down, its answer up."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.counted = Counted(monkeypatch)
        self.rasters: list[tuple[int, int]] = []
        self.answers: list[tuple[int, int]] = []
        network_pictures, set_panel = GlState.network_pictures, GlState.set_panel

        def noted_pictures(surround: GlState) -> Any:
            seen = network_pictures(surround)
            self.rasters.extend((image.shape[1], image.shape[0]) for image in seen)
            return seen

        def noted_panel(surround: GlState, panel: int, codes: Any, *, shown: bool) -> None:
            self.answers.append((codes.shape[1], codes.shape[0]))
            set_panel(surround, panel, codes, shown=shown)

        monkeypatch.setattr(GlState, "network_pictures", noted_pictures)
        monkeypatch.setattr(GlState, "set_panel", noted_panel)

    def assert_only_the_network_s(self, rig: Rig, *, solutions: int) -> None:
        """Of so many solutions from here on; counted from between two solutions to between two others."""
        # The wrapped functions are those in use.
        assert any(name == "glReadPixels" for name, _, _ in self.counted.calls)
        assert any(name == "glTexSubImage2D" for name, _, _ in self.counted.uploads)
        lists: tuple[list[Any], ...] = (self.counted.calls, self.counted.uploads, self.rasters, self.answers)
        rig.settle(lambda: [one.clear() for one in lists])
        rig.refresh_until_solved(times=solutions)
        found: list[list[Any]] = []
        rig.settle(lambda: found.extend(list(one) for one in lists))
        reads, uploads, rasters, answers = found
        assert len(rasters) >= 2 * solutions
        assert [(name, size) for name, size, _ in reads] == [("glReadPixels", size) for size in rasters]
        assert [(name, size) for name, size, _ in uploads] == [("glTexSubImage2D", size) for size in answers]


@pytest.fixture
def crossing(monkeypatch: pytest.MonkeyPatch) -> Crossing:
    return Crossing(monkeypatch)


def test_nothing_is_read_back_in_the_loop_but_the_network_s_raster(outputs: dict[str, Any], crossing: Crossing) -> None:
    with Rig(model=MODEL, tracker=HELD, **outputs) as rig:
        rig.refresh_until_solved()
        crossing.assert_only_the_network_s(rig, solutions=4)
        solution = left_in_textures(rig)
        before = len(crossing.counted.calls)
        assert solution.layers.std() > 5  # whoever asks gets the pixels
        assert len(crossing.counted.calls) > before


def test_of_a_window_of_the_plan_nothing_else_crosses(crossing: Crossing) -> None:
    with Rig(model=MODEL, tracker=HELD, content={"scene": "sparse"}) as rig:
        rig.refresh_until_solved()
        crossing.assert_only_the_network_s(rig, solutions=4)
        assert 0 < rig.run.parts.solver.measured.left_out.solved_share < 0.5
        layers = left_in_textures(rig).layers
        assert np.unique(layers[0, :8]).tolist() == [NEUTRAL, 255]  # beside the window outer panels are even
        assert layers[0].std() > 1


def left_in_textures(rig: Rig) -> Solution:
    """What is shown, which a solver left for the panels to sample."""
    solution: Solution = rig.presenter.last.solution  # type: ignore[union-attr]
    assert isinstance(solution.made, LayerTextures)
    assert lies_in(solution.made, rig.presenter.panels.group)
    return solution


def test_panels_show_the_solution_from_its_textures(server: xserver.XServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DISPLAY", server.name)
    with Rig(model=MODEL, **on_windows()) as rig:
        rig.refresh_until_solved(times=2)
        rig.presenter.paused = True
        rig.settle()
        frame = rig.presenter.last.frame  # type: ignore[union-attr]
        assert isinstance(frame.solved, LayerTextures)
        expected = shown_layers(frame)
        rig.presenter.panels.present(frame)
        for index in range(3):
            assert eventually(lambda index=index: close(server.panel(index), expected[index, ..., :3])), index


def close(shown: np.ndarray, expected: np.ndarray) -> bool:
    return bool(np.abs(shown.astype(int) - expected).max() <= 1)


def test_monitors_that_come_and_go_leave_the_solver_its_textures(
    server: xserver.XServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DISPLAY", server.name)
    monkeypatch.setattr("runtime.panels.window.RETRY_NS", NS_PER_S // 20)
    with Rig(model=MODEL, **on_windows()) as rig:
        rig.refresh_until_solved()
        parts, group = rig.run.parts, rig.presenter.panels.group
        for _ in range(2):
            server.unplug(1)
            rig.refresh_until(lambda: "panel" in rig.presenter.missing)
            server.plug(1)
            rig.refresh_until(lambda: "panel" not in rig.presenter.missing)
            rig.refresh_until_solved()
        assert rig.run.parts is parts
        assert rig.presenter.panels.group is group
        assert "model" not in rig.presenter.missing


def test_a_context_that_the_panels_lost_is_made_anew_with_the_solver(
    server: xserver.XServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DISPLAY", server.name)
    monkeypatch.setattr("runtime.panels.window.RETRY_NS", NS_PER_S // 20)
    with Rig(model=MODEL, abandon_s=0.2, loop={"rate_hz": 100.0}, **on_windows()) as rig:
        rig.refresh_until_solved()
        parts, group, connected = rig.run.parts, rig.presenter.panels.group, connection()
        monkeypatch.setattr("runtime.panels.window._reset_status", lambda: "was reset (0x8253)")
        rig.refresh_until(lambda: "panel" in rig.presenter.missing)
        monkeypatch.undo()
        monkeypatch.setenv("DISPLAY", server.name)
        assert group is not None and group.lost
        rig.refresh_until(lambda: rig.presenter.panels.group not in (None, group))
        rig.refresh_until(lambda: rig.run.parts is not parts and not rig.presenter.missing)
        account = rig.refresh_until_solved()
        assert account.presented
        assert connection() == connected  # a thread that draws may have used it all the time
        # The first solution may have been under way while there was no context to share.
        rig.refresh_until(lambda: isinstance(rig.presenter.last.solution.made, LayerTextures))  # type: ignore[union-attr]
        made = rig.presenter.last.solution.made  # type: ignore[union-attr]
        assert isinstance(made, LayerTextures)
        assert made.group is rig.presenter.panels.group


def connection() -> int:
    """The X connection of this process's GLFW, by its socket's number: no two ever have the same."""
    x11 = ctypes.CDLL("libX11.so.6")
    return os.fstat(x11.XConnectionNumber(ctypes.c_void_p(glfw.get_x11_display()))).st_ino


def test_where_the_driver_can_t_share_solutions_are_read_back(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("panels.registry", "panels.display"):
        monkeypatch.setattr(f"runtime.{module}.shared", lambda: None)
    with Rig(model=MODEL) as rig:
        rig.refresh_until_solved()
        assert rig.run.parts.backend.backend.name == "gl"
        assert isinstance(rig.presenter.last.solution.made, np.ndarray)  # type: ignore[union-attr]
