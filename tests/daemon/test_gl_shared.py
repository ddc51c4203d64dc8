"""The whole loop with the OpenGL backend: solver and panels share textures, and only the network's raster crosses."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from runtime.model.gl.surround import GlSurround
from runtime.optics.alignment import shown_layers
from runtime.support.gl_sharing import LayerTextures
from tests.daemon.rig import Rig
from tests.panels import xserver
from tests.support.gl_calls import Counted
from tests.waiting import eventually

MODEL = {"backend": "gl"}
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


def test_nothing_is_read_back_in_the_loop_but_the_network_s_raster(
    outputs: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    counted = Counted(monkeypatch)
    rasters: list[tuple[int, int]] = []
    network_pictures = GlSurround.network_pictures

    def noted(self: GlSurround) -> Any:
        seen = network_pictures(self)
        rasters.extend((image.shape[1], image.shape[0]) for image in seen)
        return seen

    monkeypatch.setattr(GlSurround, "network_pictures", noted)
    with Rig(model=MODEL, **outputs) as rig:
        rig.refresh_until_solved()
        rig.settle()
        assert any(name == "glReadPixels" for name, _, _ in counted.calls)  # the wrapped functions are those in use
        counted.calls.clear()
        rasters.clear()
        rig.refresh_until_solved(times=4)
        rig.settle()
        seen = list(counted.calls)
        assert len(rasters) >= 2 * 4
        assert [(name, size) for name, size, _ in seen] == [("glReadPixels", size) for size in rasters]
        solution = rig.presenter.last.solution  # type: ignore[union-attr]
        assert solution is not None
        assert isinstance(solution.made, LayerTextures)
        assert solution.layers.std() > 5  # whoever asks gets the pixels
        assert len(counted.calls) > len(seen)


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
    loop = {"rate_hz": 100.0, "solver_late_s": 5.0, "solver_abandon_s": 0.2}
    with Rig(model=MODEL, loop=loop, **on_windows()) as rig:
        rig.refresh_until_solved()
        parts, group = rig.run.parts, rig.presenter.panels.group
        monkeypatch.setattr("runtime.panels.window._reset_status", lambda: "was reset (0x8253)")
        rig.refresh_until(lambda: "panel" in rig.presenter.missing)
        monkeypatch.undo()
        monkeypatch.setenv("DISPLAY", server.name)
        assert group is not None and group.lost
        rig.refresh_until(lambda: rig.presenter.panels.group not in (None, group))
        rig.refresh_until(lambda: rig.run.parts is not parts and not rig.presenter.missing)
        account = rig.refresh_until_solved()
        assert account.presented
        made = rig.presenter.last.solution.made  # type: ignore[union-attr]
        assert isinstance(made, LayerTextures)
        assert made.group is rig.presenter.panels.group


def test_where_the_driver_can_t_share_solutions_are_read_back(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("panels.offscreen", "panels.display"):
        monkeypatch.setattr(f"runtime.{module}.shared", lambda: None)
    with Rig(model=MODEL) as rig:
        rig.refresh_until_solved()
        assert rig.run.parts.backend.backend.name == "gl"
        assert isinstance(rig.presenter.last.solution.made, np.ndarray)  # type: ignore[union-attr]
