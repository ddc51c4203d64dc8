"""Windows of the plan, put together in textures: code for code as on the processor."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from runtime.config import ModelSettings
from runtime.content.procedural import ProceduralSource
from runtime.errors import ContextLost
from runtime.model.assembly import ArrayAssembly, Placed, Rest, Shared, Uniform
from runtime.model.gl.assembly import GlAssembly
from runtime.model.gl.backend import GlBackend
from runtime.model.job import Job
from runtime.model.predictor import Predictor, load_predictor
from runtime.model.reprojection import NEUTRAL
from runtime.model.trim import Scene, trim
from runtime.optics.rect import PixelRect
from runtime.optics.stack import PanelStack
from runtime.plan.drawing import drawn_for, raster_views
from runtime.records import F64, U8
from runtime.support.gl import offscreen_context
from runtime.support.gl_sharing import LayerPool, LayerTextures, ShareGroup
from tests.model.gl_account import counted
from tests.model.plain_panels import hold_exactly
from tests.model.scenes import eyes
from tests.support.left_in_textures import written

STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 240, 135)
WITHIN_ONE = 0.999  # of all codes
WALK = [eyes(0.6), eyes(0.6, 0.1, 0.02), eyes(0.7, -0.2), eyes(0.6, 0.1, roll_deg=15)]
NETWORK = ["numbers down"] * 2 + ["numbers up"] * 2


@pytest.fixture(scope="module")
def made() -> Iterator[tuple[Any, ShareGroup, GlBackend]]:
    context = offscreen_context()
    group = ShareGroup()
    yield context, group, GlBackend(context, STACK, group=group)
    group.close()
    context.__enter__()
    context.release()


@pytest.fixture
def gl(made: tuple[Any, ShareGroup, GlBackend]) -> Iterator[GlBackend]:
    """Whose layers are left in textures."""
    context, _, backend = made
    with context:
        yield backend


@pytest.fixture
def pool(made: tuple[Any, ShareGroup, GlBackend], gl: GlBackend) -> LayerPool:
    return LayerPool(gl.context, made[1])


@pytest.fixture
def exactly(monkeypatch: pytest.MonkeyPatch) -> None:
    """OpenCV's steps sample by the definition."""
    hold_exactly(monkeypatch)


def noise(width_px: int, height_px: int, *, count: int | None = None, seed: int = 0) -> U8:
    shape = (height_px, width_px, 4) if count is None else (count, height_px, width_px, 4)
    found: U8 = np.random.default_rng(seed).integers(0, 256, shape, np.uint8)
    found[..., 3] = 255
    return found


def within_one(first: U8, second: U8) -> float:
    return float((np.abs(first.astype(np.int16) - second)[..., :3] <= 1).mean())


def assert_alike(found: LayerTextures, wanted: U8, *, exact: bool) -> None:
    """Where a picture is sharpened, a half may be rounded to either side."""
    for panel, (first, second) in enumerate(zip(wanted, found.pixels(), strict=True)):
        assert within_one(first, second) >= WITHIN_ONE
        if exact or panel != 1:
            assert (first[..., :3] == second[..., :3]).all()
        assert (second[..., 3] == 255).all()


def drawn(predictor: Predictor, content: ProceduralSource, eyes_m: F64, *, aim: bool = True) -> Job:
    """What is asked for: drawn where the content lies, or looked through for where the pictures differ."""
    if aim:
        return drawn_for(predictor, content, eyes_m, time_ns=0, trimmed=True)
    pictures = [[content.render(view, time_ns=0).copy()] for view in raster_views(eyes_m, STACK.panel(1))]
    return trim(Job(pictures, eyes_m), Scene(STACK))[0]


def both(gl: GlBackend) -> tuple[Predictor, Predictor]:
    """A model on the processor, and by OpenGL."""
    cpu, opengl = (load_predictor("fast", STACK, ModelSettings(threads=1)) for _ in range(2))
    opengl.set_backend(gl)
    return cpu, opengl


def test_a_window_among_the_rest_is_put_there_as_the_processor_does_it(gl: GlBackend, pool: LayerPool) -> None:
    width, height = STACK.width_px, STACK.height_px
    picture = Shared(noise(width, height, seed=1), 0.1)
    steps: Sequence[tuple[Rest, PixelRect | None, PixelRect | None]] = (
        (Uniform((255, 255, 255)), PixelRect(40, 30, 104, 94), PixelRect(48, 40, 96, 90)),
        (Uniform((255, 255, 255)), PixelRect(40, 30, 104, 94), PixelRect(44, 36, 100, 84)),
        (Uniform((0, 100, 200)), PixelRect(0, 0, 64, 64), PixelRect(0, 0, 50, 50)),
        (picture, PixelRect(0, 0, 64, 64), PixelRect(0, 0, 50, 50)),
        (picture, PixelRect(176, 71, 240, 135), PixelRect(180, 80, 240, 135)),
        (picture, None, None),
        (replace(picture, emphasis=0.0), None, None),
        (Uniform((0, 100, 200)), PixelRect(80, 30, 144, 94), PixelRect(100, 50, 100, 50)),  # no ray stays within
    )
    arrays, textures = ArrayAssembly(STACK), GlAssembly(gl.passes, pool, STACK)
    for number, (rest, box, kept) in enumerate(steps):
        windows: list[Placed | None] = [None, None]
        if box is not None and kept is not None:
            layers = noise(box.width_px, box.height_px, count=3, seed=number)
            windows = [Placed(one, box, kept) for one in (layers, written(pool, layers))]
        wanted, found = arrays.assembled(rest, windows[0]), textures.assembled(rest, windows[1])
        assert isinstance(found, LayerTextures)
        assert_alike(found, wanted, exact=isinstance(rest, Uniform))
    textures.close()


def test_arrays_are_put_together_on_the_processor(gl: GlBackend, pool: LayerPool) -> None:
    textures, box = GlAssembly(gl.passes, pool, STACK), PixelRect(40, 30, 104, 94)
    window = Placed(noise(64, 64, count=3), box, box)
    assert isinstance(textures.assembled(Uniform((1, 2, 3)), window), np.ndarray)
    layers, picture = noise(135, 240, count=3), noise(240, 135)
    assert (textures.transposed(layers) == layers.transpose(0, 2, 1, 3)).all()
    assert (textures.transposed_picture(picture, 0) == picture.transpose(1, 0, 2)).all()
    assert gl.assembly(STACK).assembled(Uniform((1, 2, 3)), None).shape == (3, 135, 240, 4)
    assert isinstance(GlBackend(gl.context, STACK).assembly(STACK), ArrayAssembly)  # nobody shows its textures


@pytest.mark.usefixtures("exactly")
@pytest.mark.parametrize("aim", [True, False], ids=["drawn in the window", "found in the pictures"])
def test_windows_of_the_plan_stay_in_textures(aim: bool, gl: GlBackend) -> None:
    content = ProceduralSource("sparse", stack=STACK, context=gl.context, background=(0.5, 0.6, 0.7))
    cpu, opengl = both(gl)
    for eyes_m in WALK:
        wanted = cpu.solve(drawn(cpu, content, eyes_m, aim=aim)).layers.copy()
        with counted() as account:
            job = drawn(opengl, content, eyes_m, aim=aim)
            found = opengl.solve(job).made
        assert 0 < job.solved_share(STACK) < 0.6
        assert isinstance(found, LayerTextures)
        assert within_one(wanted, found.pixels()) >= WITHIN_ONE
        # Pictures that are looked through are read; one that both eyes see besides goes up once, as the others do.
        assert sorted(account.crossed) == sorted(NETWORK + ([] if aim else ["codes down"] * 2 + ["codes up"] * 3))
    content.close()


def test_pictures_that_are_alike_are_shown_from_textures(gl: GlBackend) -> None:
    picture = noise(STACK.width_px, STACK.height_px)
    cpu, opengl = both(gl)
    job, savings = trim(Job([[picture], [picture]], eyes(0.6)), Scene(STACK))
    with counted() as account:
        wanted, found = (predictor.solve(job) for predictor in (cpu, opengl))
    assert savings.solved_share == 0.0
    assert isinstance(found.made, LayerTextures)
    assert_alike(found.made, wanted.layers, exact=False)
    assert (found.layers[0, ..., :3] == NEUTRAL).all()
    assert account.crossed == ["codes up"]


@pytest.mark.usefixtures("exactly")
@pytest.mark.parametrize("scene", ["demo", "sparse"])
def test_solutions_for_eyes_above_each_other_stay_in_textures(scene: str, gl: GlBackend) -> None:
    content = ProceduralSource(scene, stack=STACK, context=gl.context)
    cpu, opengl = both(gl)
    for head in (0.0, 0.05, -0.05):
        eyes_m = np.array([[0.6, head, -0.031], [0.6, head, 0.031]])[:: -1 if head < 0 else 1]
        wanted = cpu.solve(drawn(cpu, content, eyes_m)).layers
        with counted() as account:
            job = drawn(opengl, content, eyes_m)
            found = opengl.solve(job).made
        assert (job.solved_share(STACK) < 0.6) == (scene == "sparse")
        assert isinstance(found, LayerTextures)
        assert within_one(wanted, found.pixels()) >= WITHIN_ONE
        assert account.crossed == NETWORK
    content.close()


def test_textures_do_not_grow_while_a_viewer_walks(gl: GlBackend) -> None:
    content = ProceduralSource("sparse", stack=STACK, context=gl.context)
    _, opengl = both(gl)
    assert gl._pool is not None
    counts = []
    for _ in range(3):
        held = []  # as the newest solution and the one on the panels are
        for eyes_m in WALK:
            held = [*held[-1:], opengl.solve(drawn(opengl, content, eyes_m)).made]
        counts.append((gl._pool.count, len(gl.passes._targets)))
    assert counts[1] == counts[2]
    opengl.close()
    content.close()


def test_a_context_that_is_lost_is_told(pool: LayerPool, gl: GlBackend) -> None:
    lost = offscreen_context()
    backend = GlBackend(lost, STACK, group=ShareGroup())
    predictor = load_predictor("fast", STACK, ModelSettings(threads=1))
    predictor.set_backend(backend)
    picture = noise(STACK.width_px, STACK.height_px)
    job = Job([[picture], [picture]], eyes(0.6))
    predictor.solve(job)
    lost.release()
    with pytest.raises(ContextLost):
        predictor.solve(job)
    gl.context.__enter__()
    predictor.set_backend(gl)
    assert predictor.solve(job).layers.std() > 1
