"""The loop's solver with the OpenGL backend: what it reads back, and what becomes of a lost context."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import count
from typing import Any

import moderngl
import numpy as np
import pytest

import runtime.model.cpu
import runtime.model.pyramid_level
from runtime.clock import MonotonicClock
from runtime.config import Settings
from runtime.daemon.solver_parts import RunningSolver, SolverMaker
from runtime.eyes.calibration import load_calibration
from runtime.frame.solver_thread import SolverThread
from runtime.model.chain import chain_frame
from runtime.optics.stack import PanelStack
from runtime.records import SolveRequest
from runtime.support.gl import offscreen_context
from tests.daemon.gl_soak import soaked
from tests.model.exact import exact_resample
from tests.waiting import eventually

STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 240, 136)
EYES_M = np.array([[0.6, -0.031, 0.05], [0.6, 0.031, 0.05]])


def settings_of(backend: str, scene: str = "demo") -> Settings:
    return Settings.model_validate(
        {"model": {"name": "balanced", "threads": 1, "backend": backend}, "content": {"scene": scene}}
    )


def maker_of(backend: str, scene: str = "demo") -> SolverMaker:
    return SolverMaker(settings_of(backend, scene), STACK, load_calibration(None))


def wish(number: int = 0) -> SolveRequest:
    eyes_m = EYES_M + np.array([0.0, 0.05 * number, 0.0])
    return SolveRequest(number, eyes_m, "predicted", 0.001, flat_wanted=False)


@pytest.fixture
def parts() -> Iterator[RunningSolver]:
    context = offscreen_context()
    with context:
        made = maker_of("gl")(context=context, simulated=True)
        assert made.backend.backend.name == "gl"
        yield made
        made.close()


@pytest.fixture
def read_bytes(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The size of everything that is read back from now on."""
    found: list[int] = []

    def counted(call: Callable[..., Any], size: Callable[[Any], int]) -> Callable[..., Any]:
        def wrapped(self: Any, *given: Any, **how: Any) -> Any:
            answer = call(self, *given, **how)
            found.append(size(given[0] if given and given[0] is not None else answer))
            return answer

        return wrapped

    def size_of(data: Any) -> int:
        return memoryview(data).nbytes

    for kind in (moderngl.Framebuffer, moderngl.Texture, moderngl.TextureArray, moderngl.Buffer):
        for name in ("read", "read_into"):
            monkeypatch.setattr(kind, name, counted(getattr(kind, name), size_of))
    return found


def test_nothing_is_read_back_but_the_network_s_raster_and_the_layers(
    parts: RunningSolver, read_bytes: list[int]
) -> None:
    assert parts.step(wish()).flat is not None  # drawn first, from an array
    read_bytes.clear()
    assert parts.step(wish()).solution is not None
    predictor: Any = parts.run.state.predictor
    contract = predictor.session.contract
    layer = STACK.width_px * STACK.height_px * 4
    raster = [size for size in read_bytes if size != layer]
    assert read_bytes.count(layer) == 3  # pictures of the panels' size would be so large, too: two more
    assert len(raster) == 2
    frame = chain_frame(EYES_M, STACK, cell_px=contract.cell_px, reduction=contract.reduction)
    assert raster == [frame.rows * frame.width_px * 3 * 2] * 2


@pytest.mark.parametrize("scene", ["demo", "texture", "grey", "thin"])
def test_pictures_in_textures_are_solved_as_pictures_in_arrays_are(scene: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (runtime.model.cpu, runtime.model.pyramid_level):
        monkeypatch.setattr(module, "resample", exact_resample)
    monkeypatch.setattr(runtime.model.cpu, "CompiledLevel", runtime.model.pyramid_level.PyramidLevel)
    layers = []
    for backend in ("gl", "cpu"):
        context = offscreen_context()
        with context:
            made = maker_of(backend, scene)(context=context, simulated=True)
            made.step(wish())
            solution = made.step(wish()).solution
            assert solution is not None
            layers.append(solution.layers.astype(np.int16))
            made.close()
    assert (np.abs(layers[0] - layers[1]) <= 1).mean() >= 0.999


def test_a_lost_context_is_made_anew_from_the_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("runtime.frame.solver_thread.LATE_S", 60.0)
    monkeypatch.setattr("runtime.frame.solver_thread.ABANDON_S", 0.1)
    maker = maker_of("gl")
    host = SolverThread(maker, MonotonicClock())
    try:
        host.wait_ready()
        host.post(wish())
        assert eventually(lambda: host.news().solution is not None, within_s=60.0)
        first, solution = maker.parts, host.news().solution
        assert solution is not None

        def lose(parts: Any) -> bool:
            parts.context.release()
            return True

        host.do(lose)

        places = count(1)

        def asked_again() -> bool:
            host.post(wish(next(places) % 5))  # eyes that move: there is always something to solve
            news = host.news()
            solved = news.solution is not None and news.solution.number > solution.number
            return maker.parts is not first and solved and not news.missing

        assert eventually(asked_again, within_s=60.0)
        assert maker.parts is not None
        assert maker.parts.backend.backend.name == "gl"
    finally:
        host.close()


@pytest.mark.slow
def test_thousands_of_solutions_with_contexts_lost_under_way_do_not_grow() -> None:
    found = soaked(2000, lost_every=500, look_every=100)
    assert found.lost == 3
    assert found.shown == 2000
    first, last = found.looks[0], found.looks[-1]
    assert sum(last.objects.values()) <= sum(first.objects.values()) + 6  # two solutions more may be held just then
    assert last.resident_mib - first.resident_mib < 64  # the process's, after the first hundred


def test_a_lost_context_leaves_no_object_behind() -> None:
    """Depth once lay in renderbuffers, which Mesa keeps where another context of the group releases them."""
    found = soaked(60, lost_every=5, look_every=5)
    assert found.lost == 11
    assert {look.objects["renderbuffers"] for look in found.looks} == {0}
    assert sum(found.looks[-1].objects.values()) <= sum(found.looks[0].objects.values()) + 6
