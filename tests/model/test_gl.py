"""OpenGL does what the processor does: code for code where both sample exactly, and by the eye."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from moderngl import Framebuffer, Texture

from runtime.config import ModelSettings
from runtime.errors import ContextLost, InputError, MissingPart, ModelFailure
from runtime.evaluation.displayed import displayed, expected_quality
from runtime.model.backends import choose
from runtime.model.gl.state import GlBackend, GlState
from runtime.model.job import Job, SolveWindow, Targets, drawn_job
from runtime.model.predictor import SHIPPED, Predictor, load_predictor
from runtime.model.solver import StepPredictor
from runtime.model.still import captured_views
from runtime.model.trim import trim
from runtime.optics.carried import expected_psnrs_db
from runtime.optics.light import ONE_RAY
from runtime.optics.rect import PixelRect
from runtime.optics.stack import PanelStack, Tilt
from runtime.records import F64, U8
from runtime.support.gl import offscreen_context
from tests.model.scenes import FOV_DEG, card_scene, eyes
from tests.model_export.stills import random_still

STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 240, 135)
TILT = Tilt(((0.001, 0.012, -0.006), (0.0, 0.0, 0.0), (-0.002, 0.004, 0.015)), (1.0, 0.1, -0.05))
WITHIN_ONE = 0.85  # of all codes: where hardly any slope is left, a step makes much of a last digit
UNSURE_MM = 24.0  # pixels are eight times those of 1920x1080: as many of them as 3 mm are there
LEAST_DB = -0.05  # of displayed quality, against the processor
WINDOW = SolveWindow(PixelRect(40, 24, 200, 135), PixelRect(60, 34, 190, 130), (40.0, 10.0))
HALF_TURN = np.radians(30)
POSES = {
    "straight": eyes(0.6),
    "beside and above": eyes(0.7, 0.2, 0.1),
    "near": eyes(0.35, -0.05),
    "rolled by 20 degrees": eyes(0.6, roll_deg=20),
    "turned by 30 degrees": np.array([[0.6, 0.0, 0.0]])
    + np.outer((-0.031, 0.031), (np.sin(HALF_TURN), np.cos(HALF_TURN), 0.0)),
    "one eye for both": np.array([[0.6, 0.0, 0.0], [0.6, 0.0, 0.0]]),
    "above each other": np.array([[0.6, 0.0, -0.031], [0.6, 0.0, 0.031]]),
}


@pytest.fixture(scope="module")
def made() -> Iterator[tuple[Any, GlBackend]]:
    context = offscreen_context()
    yield context, GlBackend(context, STACK)
    context.__enter__()
    context.release()


@pytest.fixture
def gl(made: tuple[Any, GlBackend]) -> Iterator[GlBackend]:
    context, backend = made
    with context:
        yield backend


def both(name: str, stack: PanelStack, gl: GlBackend) -> tuple[StepPredictor, StepPredictor]:
    """The model on the processor, and by OpenGL."""
    cpu, opengl = (load_predictor(name, stack, ModelSettings(threads=1)) for _ in range(2))
    assert isinstance(cpu, StepPredictor) and isinstance(opengl, StepPredictor)
    return cpu, opengl.bound(backend=gl)


def cards(pair: F64, stack: PanelStack, *, grey: bool = False) -> tuple[U8, U8]:
    left, right = (card_scene(eye, width_px=stack.width_px, height_px=stack.height_px) for eye in pair)
    return (left[..., :1].repeat(3, 2), right[..., :1].repeat(3, 2)) if grey else (left, right)


def layers_of(
    predictor: Predictor,
    pictures: Sequence[U8],
    pair: F64,
    *,
    sigma_mm: float = 1.0,
    fov_deg: float = FOV_DEG,
    changed: Callable[[Job], Job] = lambda job: job,
) -> U8:
    views = captured_views(pictures, pair, predictor.stack, fov_deg=fov_deg)
    job = changed(Job(Targets(predictor.stack, pair, views), eye_sigma_m=sigma_mm / 1e3))
    layers: U8 = predictor.solve(job).layers.copy()
    return layers


def drawn(predictor: Predictor, pictures: tuple[U8, U8], pair: F64, window: SolveWindow | None = None) -> U8:
    """Layers for pictures that lie on the middle panel's pixels."""
    rgba = [np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2RGBA), np.uint8) for picture in pictures]
    layers: U8 = predictor.solve(replace(drawn_job(rgba, pair, predictor.stack), window=window)).layers.copy()
    return layers


def within_one(first: U8, second: U8) -> float:
    return float((np.abs(first.astype(np.int16) - second)[..., :3] <= 1).mean())


@pytest.mark.parametrize("sigma_mm", [0.0, UNSURE_MM])
@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("name", SHIPPED)
def test_codes_are_the_processors(name: str, pose: str, sigma_mm: float, gl: GlBackend) -> None:
    pictures, pair = cards(POSES[pose], STACK), POSES[pose]
    wanted, found = (layers_of(p, pictures, pair, sigma_mm=sigma_mm) for p in both(name, STACK, gl))
    assert within_one(wanted, found) >= WITHIN_ONE
    assert (found[..., 3] == 255).all()


MORE_STACKS = {
    "two": replace(STACK, x_m=(-0.03, 0.03)),
    "four": replace(STACK, x_m=(-0.09, -0.03, 0.03, 0.09)),
    "six, uneven": replace(STACK, x_m=(-0.06, -0.04, -0.01, 0.01, 0.03, 0.06)),
    "front without filters": replace(STACK, colour=(True, True, False)),
    "middle without filters": replace(STACK, colour=(True, False, True)),
}


@pytest.mark.parametrize("views", [2, 4, 8])
@pytest.mark.parametrize("stack", MORE_STACKS)
def test_codes_of_any_panels_for_any_number_of_views(stack: str, views: int, gl: GlBackend) -> None:
    at = np.concatenate([eyes(0.6, side_m) for side_m in (-0.15, 0.15, 0.0, 0.25)])[:views]
    pictures = [card_scene(eye, width_px=240, height_px=135) for eye in at]
    wanted, found = (
        layers_of(p, pictures, at, sigma_mm=UNSURE_MM, changed=lambda job: replace(job, steps=4))
        for p in both("balanced", MORE_STACKS[stack], gl)
    )
    assert within_one(wanted, found) >= WITHIN_ONE
    for n in range(len(found)):
        assert not MORE_STACKS[stack].is_grey(n) or (np.ptp(found[n, ..., :3], axis=-1) == 0).all()


@pytest.mark.parametrize("pose", ["straight", "rolled by 20 degrees", "above each other"])
def test_codes_on_tilted_panels(pose: str, gl: GlBackend) -> None:
    stack, pair = replace(STACK, tilt=TILT), POSES[pose]
    pictures = cards(pair, stack)
    wanted, found = (layers_of(p, pictures, pair) for p in both("balanced", stack, gl))
    assert within_one(wanted, found) >= WITHIN_ONE
    flat = layers_of(both("balanced", STACK, gl)[1], pictures, pair)
    assert within_one(flat, found) < 0.9  # the tilt is felt


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("window", [None, WINDOW, replace(WINDOW, colour=(200, 200, 200))])
def test_codes_of_what_is_drawn_whole_or_in_part(window: SolveWindow | None, channels: int, gl: GlBackend) -> None:
    pair = eyes(0.6)
    grey = cards(pair, STACK, grey=channels == 1)
    found = [drawn(predictor, grey, pair, window) for predictor in both("balanced", STACK, gl)]
    assert within_one(*found) >= WITHIN_ONE
    own = [
        layers_of(predictor, grey, pair, changed=lambda job: replace(job, window=window, channels=channels))
        for predictor in both("balanced", STACK, gl)
    ]
    assert within_one(*own) >= WITHIN_ONE


def test_windows_of_the_plan(gl: GlBackend) -> None:
    """A sparse picture is solved in a window of its own."""
    stack = replace(STACK, width_px=480, height_px=270)
    pictures = tuple(np.full((270, 480, 3), 255, np.uint8) for _ in range(2))
    for picture, shift in zip(pictures, (4, -4), strict=True):
        picture[110:150, 220 + shift : 260 + shift] = np.random.default_rng(0).integers(0, 200, (40, 40, 3))
    layers = []
    for predictor in both("balanced", stack, gl):
        views = captured_views(pictures, eyes(0.6), stack, fov_deg=FOV_DEG)
        prediction = predictor.solve(trim(Job(Targets(stack, eyes(0.6), views))))
        layers.append(prediction.layers)
        assert 0 < prediction.savings.solved_share < 1
    assert within_one(*layers) >= WITHIN_ONE


@pytest.mark.parametrize("number", range(8))
def test_codes_on_random_pairs(number: int, gl: GlBackend) -> None:
    """Panels, gaps, places and heads of the whole design range."""
    pair = random_still(7, number, width_px=STACK.width_px, height_px=STACK.height_px)
    found = [layers_of(p, pair.images, pair.eyes_m, fov_deg=pair.fov_deg) for p in both("balanced", pair.stack, gl)]
    assert within_one(*found) >= WITHIN_ONE


@pytest.mark.parametrize("sigma_mm", [1.0, UNSURE_MM])
@pytest.mark.parametrize("pose", ["straight", "rolled by 20 degrees", "turned by 30 degrees"])
def test_the_eyes_see_no_less_than_on_the_processor(pose: str, sigma_mm: float, gl: GlBackend) -> None:
    pair = POSES[pose]
    pictures, shown = cards(pair, STACK), []
    for predictor in both("balanced", STACK, gl):
        layers = layers_of(predictor, pictures, pair, sigma_mm=sigma_mm)
        look = displayed(layers, pictures, STACK, eyes_m=pair, fov_deg=FOV_DEG, similarity=False)
        expected = expected_quality(look, layers, sampling=ONE_RAY).db
        shown.append([look.quality.psnr_db, *(value for value in expected.values() if value is not None)])
    assert len(shown[0]) == 4
    assert (np.array(shown[1]) - shown[0] >= LEAST_DB).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", SHIPPED)
def test_at_1920x1080(name: str, gl: GlBackend) -> None:
    stack, pair = replace(STACK, width_px=1920, height_px=1080), eyes(0.6)
    pictures = cards(pair, stack)
    found = [layers_of(predictor, pictures, pair) for predictor in both(name, stack, gl)]
    how: Any = {"eyes_m": pair, "fov_deg": FOV_DEG, "sigmas_mm": [1.0]}
    light_db = [expected_psnrs_db(layers, pictures, stack, **how)[1.0] for layers in found]
    assert abs(light_db[1] - light_db[0]) <= 0.05
    assert within_one(*found) >= WITHIN_ONE


def test_a_panel_wider_than_the_driver_allows_is_refused(gl: GlBackend) -> None:
    widest = int(gl.passes.context.info["GL_MAX_TEXTURE_SIZE"])
    stack = replace(STACK, width_px=widest + 8)
    predictor = load_predictor("fast", STACK)
    assert isinstance(predictor, StepPredictor)
    with pytest.raises(
        InputError, match=rf"stack: width_px: is {widest + 8}, but this OpenGL driver allows at most {widest}"
    ):
        choose("gl", predictor.bound(stack=stack), lambda: gl.passes.context)
    with pytest.raises(InputError, match=r"height_px: is \d+, but"):
        gl.state(replace(STACK, height_px=widest + 8), threads=1)


def test_only_pictures_the_networks_answer_and_layers_cross(gl: GlBackend, monkeypatch: pytest.MonkeyPatch) -> None:
    """Down: the layers, where arrays are asked for. Up: pictures and the network's answer, besides small tables."""
    kinds, crossed = {"f1": "codes", "nu2": "numbers", "i2": "numbers"}, list[str]()
    write, read = Texture.write, Framebuffer.read_into

    def written(self: Any, *given: Any, **more: Any) -> None:
        crossed.append(f"{kinds.get(self.dtype, 'tables')} up")
        write(self, *given, **more)

    def read_into(self: Any, *given: Any, **more: Any) -> None:
        crossed.append(f"{kinds[more.get('dtype', 'f1')]} down")
        read(self, *given, **more)

    _, opengl = both("balanced", STACK, gl)
    monkeypatch.setattr(Texture, "write", written)
    monkeypatch.setattr(Framebuffer, "read_into", read_into)
    layers_of(opengl, cards(eyes(0.6), STACK), eyes(0.6))
    wanted = ["codes up"] * 2 + ["numbers up"] * 2 + ["codes down"] * 3
    assert [what for what in crossed if what != "tables up"] == wanted


def test_automatic_takes_the_faster_one_and_says_what_was_measured(gl: GlBackend) -> None:
    choice = choose("auto", load_predictor("fast", STACK), lambda: gl.passes.context)
    assert choice.why.startswith("the faster at ")
    cpu_ms, gl_ms = (float(part.split(" ms")[0].split()[-1]) for part in choice.why.split(", "))
    assert choice.backend.name == ("gl" if gl_ms < cpu_ms else "cpu")


def test_without_opengl_automatic_is_the_processor_and_gl_is_refused() -> None:
    def nothing() -> Any:
        raise MissingPart("cannot create an OpenGL context without a screen")

    predictor = load_predictor("fast", STACK)
    choice = choose("auto", predictor, nothing)
    assert choice.backend.name == "cpu"
    assert "OpenGL is not available" in choice.why
    with pytest.raises(MissingPart):
        choose("gl", predictor, nothing)


@pytest.mark.parametrize("failing", ["cpu", "gl"])
def test_automatic_is_the_processor_and_says_which_backend_failed(
    gl: GlBackend, monkeypatch: pytest.MonkeyPatch, failing: str
) -> None:
    predictor = load_predictor("fast", STACK)
    solver = type(predictor)
    real = solver.solve

    def solved(self: Any, job: Any) -> Any:
        if self.backend == failing:
            raise ModelFailure("the network's output is not finite")
        return real(self, job)

    monkeypatch.setattr(solver, "solve", solved)
    choice = choose("auto", predictor, lambda: gl.passes.context)
    assert choice.backend.name == "cpu"
    assert choice.why == f"a solution on {failing} failed: the network's output is not finite"


def test_a_model_that_has_one_backend_keeps_it() -> None:
    predictor = load_predictor("sart", STACK)
    assert choose("gl", predictor, offscreen_context).backend.name == predictor.backend == "cpu"


def test_a_lost_context_is_told_and_another_takes_over(gl: GlBackend) -> None:
    pair, lost = eyes(0.6), offscreen_context()
    predictor = load_predictor("fast", STACK)
    predictor = predictor.bound(backend=GlBackend(lost, STACK))
    before = layers_of(predictor, cards(pair, STACK), pair)
    lost.release()
    with pytest.raises(ContextLost):
        layers_of(predictor, cards(pair, STACK), pair)
    with gl.passes.context:
        predictor = predictor.bound(backend=gl)
        assert (layers_of(predictor, cards(pair, STACK), pair) == before).all()


def test_nothing_grows_while_a_viewer_walks(gl: GlBackend) -> None:
    _, opengl = both("balanced", STACK, gl)
    places = [eyes(0.5 + 0.01 * step, 0.02 * step, roll_deg=2.0 * step) for step in range(8)]
    for pair in places:
        layers_of(opengl, cards(pair, STACK), pair, sigma_mm=3.0)
    state, *_ = opengl._states.values()
    assert isinstance(state, GlState)
    held = len(state._textures)
    targets = len(gl.passes._targets)
    for pair in reversed(places):
        layers_of(opengl, cards(pair, STACK), pair, sigma_mm=3.0)
    assert len(state._textures) == held
    assert len(gl.passes._targets) == targets
    opengl.close()
    assert len(gl.passes._targets) < targets
