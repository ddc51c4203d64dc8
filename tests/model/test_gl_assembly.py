"""Windows of the plan and a budget's coarser levels, put together in textures: code for code as on the processor."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import runtime.model.opencv_surround
import runtime.model.pyramid_level
from runtime.config import Settings
from runtime.content.procedural import ProceduralSource
from runtime.errors import ContextLost
from runtime.model.assembly import ArrayAssembly, Placed, Rest, Shared, Uniform
from runtime.model.gl.assembly import GlAssembly
from runtime.model.gl.backend import GlBackend
from runtime.model.gl.programs import Account
from runtime.model.loops import Loops
from runtime.model.predictor import Predictor
from runtime.model.pyramid_level import NEUTRAL
from runtime.optics.rect import PixelRect
from runtime.optics.stack import PanelStack
from runtime.plan.drawing import drawn_for, raster_views
from runtime.plan.reduced import ladder_predictor
from runtime.records import F64, U8
from runtime.support.gl import offscreen_context
from runtime.support.gl_sharing import LayerPool, LayerTextures, ShareGroup
from tests.model.exact import exact_resample
from tests.model.scenes import eyes
from tests.support.left_in_textures import written

STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 240, 135)
WITHIN_ONE = 0.999  # of all codes
WALK = [eyes(0.6), eyes(0.6, 0.1, 0.02), eyes(0.7, -0.2), eyes(0.6, 0.1, roll_deg=15)]
NETWORK = ["network down"] * 2 + ["answer up"] * 2
SETTINGS = Settings.model_validate({"model": {"threads": 1}})


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
        backend.passes.account = None
        yield backend


@pytest.fixture
def pool(made: tuple[Any, ShareGroup, GlBackend], gl: GlBackend) -> LayerPool:
    return LayerPool(gl.context, made[1])


@pytest.fixture
def exactly(monkeypatch: pytest.MonkeyPatch) -> None:
    """OpenCV's steps sample by the definition."""
    for module in (runtime.model.opencv_surround, runtime.model.pyramid_level):
        monkeypatch.setattr(module, "resample", exact_resample)
    monkeypatch.setattr(
        runtime.model.opencv_surround, "inner_loops", lambda: Loops(runtime.model.pyramid_level.PyramidLevel, "")
    )


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


def drawn(predictor: Predictor, content: ProceduralSource, eyes_m: F64, *, aim: bool = True) -> Any:
    """What is made of the content's pictures: drawn where it lies, or looked through for where they differ."""
    if aim:
        return predictor.predict(drawn_for(predictor, content, eyes_m, time_ns=0), eyes_m).made
    views = raster_views(eyes_m, STACK.panel(1))
    return predictor.predict([[content.render(view, time_ns=0).copy()] for view in views], eyes_m).made


def both(gl: GlBackend, scale: float = 1.0) -> tuple[Any, Any]:
    """A level of the ladder surrounded by OpenCV, and by OpenGL."""
    opencv, opengl = (ladder_predictor("fast", scale, STACK, SETTINGS) for _ in range(2))
    opengl.surround_with(gl)
    return opencv, opengl


def crossed(account: Account) -> list[str]:
    return [one.name for one in account.passes if one.crosses]


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


@pytest.mark.parametrize("size", [(120, 68), (180, 101), (97, 41), (240, 135)])
def test_fewer_pixels_are_enlarged_within_one_code(size: tuple[int, int], gl: GlBackend, pool: LayerPool) -> None:
    small = noise(*size, count=3)
    textures = GlAssembly(gl.passes, pool, STACK)
    wanted, found = ArrayAssembly(STACK).enlarged(small), textures.enlarged(written(pool, small))
    assert isinstance(found, LayerTextures)
    assert within_one(wanted, found.pixels()) == 1.0


def test_arrays_are_put_together_on_the_processor(gl: GlBackend, pool: LayerPool) -> None:
    textures, box = GlAssembly(gl.passes, pool, STACK), PixelRect(40, 30, 104, 94)
    window = Placed(noise(64, 64, count=3), box, box)
    assert isinstance(textures.assembled(Uniform((1, 2, 3)), window), np.ndarray)
    assert isinstance(textures.enlarged(noise(120, 68, count=3)), np.ndarray)
    turned, picture = noise(135, 240, count=3), noise(240, 135)
    assert (textures.turned(turned) == turned.transpose(0, 2, 1, 3)).all()
    assert (textures.turned_picture(picture, 0) == picture.transpose(1, 0, 2)).all()
    assert gl.assembly(STACK).assembled(Uniform((1, 2, 3)), None).shape == (3, 135, 240, 4)
    assert isinstance(GlBackend(gl.context, STACK).assembly(STACK), ArrayAssembly)  # nobody shows its textures


@pytest.mark.usefixtures("exactly")
@pytest.mark.parametrize("aim", [True, False], ids=["drawn in the window", "found in the pictures"])
def test_windows_of_the_plan_stay_in_textures(aim: bool, gl: GlBackend) -> None:
    content = ProceduralSource("sparse", stack=STACK, context=gl.context, background=(0.5, 0.6, 0.7))
    opencv, opengl = both(gl)
    for eyes_m in WALK:
        wanted = drawn(opencv, content, eyes_m, aim=aim).copy()
        gl.passes.account = account = Account()
        found = drawn(opengl, content, eyes_m, aim=aim)
        gl.passes.account = None
        assert 0 < opencv.active_fraction == opengl.active_fraction < 0.6
        assert isinstance(found, LayerTextures)
        assert within_one(wanted, found.pixels()) >= WITHIN_ONE
        # A picture that both eyes see besides goes up once, as every picture does that is no texture.
        assert sorted(crossed(account)) == sorted(NETWORK + ([] if aim else ["picture up"] * 3))
    content.close()


def test_pictures_that_are_alike_are_shown_from_textures(gl: GlBackend) -> None:
    picture = noise(STACK.width_px, STACK.height_px)
    opencv, opengl = both(gl)
    gl.passes.account = account = Account()
    wanted, found = (predictor.predict([[picture], [picture]], eyes(0.6)) for predictor in (opencv, opengl))
    assert opengl.active_fraction == 0.0
    assert isinstance(found.made, LayerTextures)
    assert_alike(found.made, wanted.layers, exact=False)
    assert (found.layers[0, ..., :3] == NEUTRAL).all()
    assert crossed(account) == ["picture up"]


@pytest.mark.usefixtures("exactly")
@pytest.mark.parametrize("scale", [0.75, 0.5])
@pytest.mark.parametrize("scene", ["demo", "sparse"])
def test_coarser_levels_stay_in_textures(scene: str, scale: float, gl: GlBackend) -> None:
    content = ProceduralSource(scene, stack=STACK, context=gl.context)
    opencv, opengl = both(gl, scale)
    for eyes_m in WALK[:2]:
        wanted = drawn(opencv, content, eyes_m)
        gl.passes.account = account = Account()
        found = drawn(opengl, content, eyes_m)
        gl.passes.account = None
        assert isinstance(found, LayerTextures)
        assert found.shape == (3, 135, 240, 4)
        assert within_one(wanted, found.pixels()) >= WITHIN_ONE
        assert crossed(account) == NETWORK
    content.close()


@pytest.mark.usefixtures("exactly")
@pytest.mark.parametrize("scene", ["demo", "sparse"])
def test_solutions_for_eyes_above_each_other_stay_in_textures(scene: str, gl: GlBackend) -> None:
    content = ProceduralSource(scene, stack=STACK, context=gl.context)
    opencv, opengl = both(gl)
    for head in (0.0, 0.05, -0.05):
        eyes_m = np.array([[0.6, head, -0.031], [0.6, head, 0.031]])[:: -1 if head < 0 else 1]
        wanted = drawn(opencv, content, eyes_m)
        gl.passes.account = account = Account()
        found = drawn(opengl, content, eyes_m)
        gl.passes.account = None
        assert (opengl.active_fraction < 0.6) == (scene == "sparse")
        assert isinstance(found, LayerTextures)
        assert within_one(wanted, found.pixels()) >= WITHIN_ONE
        assert crossed(account) == NETWORK
    content.close()


def test_textures_do_not_grow_while_a_viewer_walks(gl: GlBackend) -> None:
    content = ProceduralSource("sparse", stack=STACK, context=gl.context)
    _, opengl = both(gl, 0.75)
    assert gl._pool is not None
    counts = []
    for _ in range(3):
        held = []  # as the newest solution and the one on the panels are
        for eyes_m in WALK:
            held = [*held[-1:], drawn(opengl, content, eyes_m)]
        counts.append((gl._pool.count, len(gl.passes._targets)))
    assert counts[1] == counts[2]
    opengl.close()
    content.close()


def test_a_context_that_is_lost_is_told(pool: LayerPool, gl: GlBackend) -> None:
    lost = offscreen_context()
    backend = GlBackend(lost, STACK, group=ShareGroup())
    predictor = ladder_predictor("fast", 1.0, STACK, SETTINGS)
    predictor.surround_with(backend)
    picture = noise(STACK.width_px, STACK.height_px)
    predictor.predict([[picture], [picture]], eyes(0.6))
    lost.release()
    with pytest.raises(ContextLost):
        predictor.predict([[picture], [picture]], eyes(0.6))
    gl.context.__enter__()
    predictor.surround_with(gl)
    assert predictor.predict([[picture], [picture]], eyes(0.6)).layers.std() > 1
