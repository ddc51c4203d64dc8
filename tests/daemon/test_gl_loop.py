"""Tests that the OpenGL backend finds the processor's solutions, and that lost contexts leak nothing."""

from __future__ import annotations

import ctypes
import os
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from runtime.clock import NS_PER_S
from runtime.config import Settings
from runtime.daemon.solver_parts import RunningSolver, SolverSetup
from runtime.optics.presentation import shown_layers
from runtime.optics.stack import PanelStack
from runtime.panels.display import glfw
from runtime.records import SolveRequest
from runtime.support.gl import offscreen_context
from tests.daemon.rig import Rig
from tests.panels import xserver
from tests.waiting import eventually

STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 240, 136)
ON_WINDOWS: dict[str, Any] = {
    "model": {"backend": "gl"},
    "loop": {"rate_hz": 100.0},
    "stack": {"width_px": xserver.WIDTH_PX, "height_px": xserver.HEIGHT_PX},
    "output": {"kind": "windows", "panels": [{"connector": f"DUMMY{index}"} for index in range(3)]},
}


@pytest.mark.parametrize("scene", ["demo", "grey"])
def test_pictures_in_textures_are_solved_as_pictures_in_arrays_are(scene: str, monkeypatch: pytest.MonkeyPatch) -> None:
    eyes_m = np.array([[0.6, -0.031, 0.05], [0.6, 0.031, 0.05]])
    request = SolveRequest(0, eyes_m, "predicted", 0.001, flat_wanted=False)
    layers = []
    for backend in ("gl", "cpu"):
        tables = {"model": {"name": "balanced", "threads": 1, "backend": backend}, "content": {"scene": scene}}
        context = offscreen_context()
        with context:
            made = RunningSolver(SolverSetup(Settings.model_validate(tables), STACK, simulated=True), context=context)
            made.step(request)
            solution = made.step(request).solution
            assert solution is not None
            layers.append(solution.layers.astype(np.int16))
            made.close()
    assert (np.abs(layers[0] - layers[1]) <= 1).mean() >= 0.999


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[xserver.XServer]:
    made = xserver.start_or_skip(tmp_path)
    monkeypatch.setenv("DISPLAY", made.name)
    monkeypatch.setattr("runtime.panels.window.RETRY_NS", NS_PER_S // 20)
    yield made
    made.stop()


def test_panels_show_opengl_s_solution_and_a_returning_monitor_keeps_the_solver(server: xserver.XServer) -> None:
    with Rig(**ON_WINDOWS) as rig:
        rig.refresh_until_solved(times=2)
        parts = rig.parts
        server.unplug(1)
        rig.refresh_until(lambda: "panel" in rig.presenter.missing)
        server.plug(1)
        rig.refresh_until(lambda: "panel" not in rig.presenter.missing)
        rig.refresh_until_solved()
        assert rig.parts is parts and parts.backend.backend.name == "gl"
        rig.presenter.paused = True
        rig.settle()
        frame = rig.presenter.last.frame  # type: ignore[union-attr]
        expected = shown_layers(frame)
        rig.presenter.panels.present(frame)
        for index in range(3):
            assert eventually(lambda n=index: np.abs(server.panel(n).astype(int) - expected[n, ..., :3]).max() <= 1)


@pytest.mark.parametrize("losses", [3, pytest.param(300, marks=[pytest.mark.slow, pytest.mark.timeout(3600)])])
def test_contexts_lost_by_the_panels_are_remade_with_the_solver_without_leaks(
    server: xserver.XServer, monkeypatch: pytest.MonkeyPatch, losses: int
) -> None:
    monkeypatch.setattr("runtime.panels.drawing.draws_in_software", lambda context: False)  # as if there were a GPU
    with Rig(**ON_WINDOWS, in_process=True) as rig:
        rig.refresh_until_solved()
        connected, held = connection(), {}
        for loss in range(losses):
            restarts, lost = rig.presenter.solver.restarts, rig.presenter.panels.contexts_lost
            with monkeypatch.context() as reset:
                reset.setattr("runtime.panels.drawing._reset_status", lambda: "the driver reset the GPU (0x8253)")
                rig.refresh_until(lambda: "panel" in rig.presenter.missing)
            assert rig.presenter.panels.contexts_lost == lost + 1
            rig.refresh_until(lambda n=restarts: rig.presenter.solver.restarts > n and not rig.presenter.missing)
            assert rig.refresh_until_solved().presented
            rig.accounts.clear()
            if loss in (losses // 3, losses - 1):
                held[loss] = resident_mib(), threading.active_count()
        assert connection() == connected  # Mesa would work on freed memory, where a thread draws
    (before_mib, before), (after_mib, after) = held.values()
    assert after <= before
    assert losses < 100 or after_mib - before_mib < 0.2 * losses  # moderngl keeps 40 KiB of each of four contexts


def connection() -> int:
    """The X connection of this process's GLFW, by its socket's number: no two ever have the same."""
    x11 = ctypes.CDLL("libX11.so.6")
    return os.fstat(x11.XConnectionNumber(ctypes.c_void_p(glfw.get_x11_display()))).st_ino


def resident_mib() -> float:
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    (resident,) = (line for line in lines if line.startswith("VmRSS:"))
    return int(resident.split()[1]) / 1024
