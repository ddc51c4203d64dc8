"""OpenGL does what the processor does: code for code where both sample exactly, and by the eye."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from runtime.config import ModelSettings
from runtime.errors import ContextLost, InputError, MissingPart
from runtime.evaluation.displayed import displayed, expected_db
from runtime.model import still
from runtime.model.backends import choose
from runtime.model.cpu import CpuBackend
from runtime.model.gl.backend import GlBackend
from runtime.model.job import Job, Part
from runtime.model.predictor import SHIPPED, Predictor, load_predictor
from runtime.model.still import solve_still
from runtime.model.trim import Savings, Scene, trim
from runtime.model.unrolled import UnrolledPredictor
from runtime.optics.rect import PixelRect
from runtime.optics.stack import PanelStack, Tilt
from runtime.records import F64, U8
from runtime.support.gl import offscreen_context
from tests.model.gl_account import counted
from tests.model.plain_panels import hold_exactly
from tests.model.scenes import FOV_DEG, card_scene, eyes
from tests.model_export.stills import random_still

STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 240, 135)
TILT = Tilt(((0.001, 0.012, -0.006), (0.0, 0.0, 0.0), (-0.002, 0.004, 0.015)), (1.0, 0.1, -0.05))
WITHIN_ONE = 0.999  # of all codes
REFINED_WITHIN_ONE = 0.997  # where corrections go on from panels in 8 bits, of which a sixteenth decides a whole code
UNSURE_MM = 24.0  # pixels are eight times those of 1920x1080: as many of them as 3 mm are there
LEAST_DB = -0.05  # of displayed quality, against the processor
PART = Part(PixelRect(40, 24, 200, 135), PixelRect(60, 34, 190, 130), (40.0, 10.0))
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


@pytest.fixture
def exactly(monkeypatch: pytest.MonkeyPatch) -> None:
    """The processor's steps sample by the definition: its own sampling is off by up to a twelfth of a pixel."""
    hold_exactly(monkeypatch)


def both(name: str, stack: PanelStack, gl: GlBackend) -> tuple[UnrolledPredictor, UnrolledPredictor]:
    """The model on the processor, and by OpenGL."""
    cpu = load_predictor(name, stack, ModelSettings(threads=1))
    assert isinstance(cpu, UnrolledPredictor)
    return cpu, UnrolledPredictor(cpu.session, stack, backend=gl)


def cards(pair: F64, stack: PanelStack, *, grey: bool = False) -> tuple[U8, U8]:
    left, right = (card_scene(eye, width_px=stack.width_px, height_px=stack.height_px) for eye in pair)
    return (left[..., :1].repeat(3, 2), right[..., :1].repeat(3, 2)) if grey else (left, right)


def layers_of(
    predictor: Predictor,
    pictures: tuple[U8, U8],
    pair: F64,
    *,
    sigma_mm: float = 1.0,
    fov_deg: float = FOV_DEG,
    refined: bool = False,
    changed: Callable[[Job], Job] = lambda job: job,
) -> U8:
    """refined: along the pictures' own rays too, which the processor does for both."""
    how: Any = {"eyes_m": pair, "fov_deg": fov_deg, "eye_sigma_mm": sigma_mm, "changed": changed}
    with pytest.MonkeyPatch.context() as patch:
        if not refined:
            patch.setattr(UnrolledPredictor, "refining", ())
        layers: U8 = solve_still(*pictures, predictor=predictor, **how).layers.copy()
    return layers


def within_one(first: U8, second: U8) -> float:
    return float((np.abs(first.astype(np.int16) - second)[..., :3] <= 1).mean())


@pytest.mark.usefixtures("exactly")
@pytest.mark.parametrize("sigma_mm", [0.0, 8.0, UNSURE_MM])
@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("name", SHIPPED)
def test_codes_are_those_of_exact_sampling(name: str, pose: str, sigma_mm: float, gl: GlBackend) -> None:
    """Sure eyes, unsure ones on every pixel (8 mm), and on coarser ones."""
    cpu, opengl = both(name, STACK, gl)
    pictures, pair = cards(POSES[pose], STACK), POSES[pose]
    wanted, found = (layers_of(p, pictures, pair, sigma_mm=sigma_mm) for p in (cpu, opengl))
    assert within_one(wanted, found) >= WITHIN_ONE
    assert (found[..., 3] == 255).all()


@pytest.mark.usefixtures("exactly")
@pytest.mark.parametrize("sigma_mm", [0.0, UNSURE_MM])
def test_codes_of_a_grey_part_of_larger_panels(sigma_mm: float, gl: GlBackend) -> None:
    pair, layers = eyes(0.6), []
    for predictor in both("balanced", STACK, gl):
        grey = cards(pair, STACK, grey=True)
        layers.append(
            layers_of(predictor, grey, pair, sigma_mm=sigma_mm, changed=lambda job: replace(job, part=PART, channels=1))
        )
    assert within_one(*layers) >= WITHIN_ONE


@pytest.mark.usefixtures("exactly")
@pytest.mark.parametrize("gap_m", [0.01, 0.03, 0.2])
def test_codes_at_every_gap(gap_m: float, gl: GlBackend) -> None:
    stack, pair = replace(STACK, x_m=(-gap_m, 0.0, gap_m)), eyes(0.9)
    wanted, found = (layers_of(p, cards(pair, stack), pair) for p in both("balanced", stack, gl))
    assert within_one(wanted, found) >= WITHIN_ONE


@pytest.mark.usefixtures("exactly")
@pytest.mark.parametrize("sigma_mm", [0.0, 3.0, UNSURE_MM])
@pytest.mark.parametrize("pose", ["straight", "rolled by 20 degrees", "above each other"])
def test_codes_on_tilted_panels(pose: str, sigma_mm: float, gl: GlBackend, monkeypatch: pytest.MonkeyPatch) -> None:
    stack, pair = replace(STACK, tilt=TILT), POSES[pose]
    pictures = cards(pair, stack)
    wanted, found = (layers_of(p, pictures, pair, sigma_mm=sigma_mm) for p in both("balanced", stack, gl))
    assert within_one(wanted, found) >= WITHIN_ONE
    # The tilt is felt; by pictures that are driven for beside their edge too: else outer panels are even there.
    monkeypatch.setattr(still, "extrapolate_border", lambda *_, **__: None)
    flat, tilted = (both("balanced", panels, gl)[1] for panels in (STACK, stack))
    assert within_one(*(layers_of(p, pictures, pair, sigma_mm=0.0) for p in (flat, tilted))) < 0.9


@pytest.mark.usefixtures("exactly")
@pytest.mark.parametrize("sigma_mm", [0.0, 3.0, UNSURE_MM])
def test_grey_pictures_in_one_channel(sigma_mm: float, gl: GlBackend) -> None:
    pair, layers = eyes(0.6), []
    for predictor in both("balanced", STACK, gl):
        grey = cards(pair, STACK, grey=True)
        layers.append(layers_of(predictor, grey, pair, sigma_mm=sigma_mm, changed=lambda job: replace(job, channels=1)))
    assert within_one(*layers) >= WITHIN_ONE


@pytest.mark.usefixtures("exactly")
def test_a_part_of_larger_panels_ends_gently(gl: GlBackend) -> None:
    pair = eyes(0.6)
    layers = [
        layers_of(predictor, cards(pair, STACK), pair, changed=lambda job: replace(job, part=PART))
        for predictor in both("balanced", STACK, gl)
    ]
    assert within_one(*layers) >= WITHIN_ONE


@pytest.mark.usefixtures("exactly")
def test_windows_of_the_plan(gl: GlBackend) -> None:
    """A sparse picture is solved in a window of its own."""
    stack = replace(STACK, width_px=480, height_px=270)
    pictures = tuple(np.full((270, 480, 3), 255, np.uint8) for _ in range(2))
    for picture, shift in zip(pictures, (4, -4), strict=True):
        picture[110:150, 220 + shift : 260 + shift] = np.random.default_rng(0).integers(0, 200, (40, 40, 3))
    layers = []
    for backend in (None, gl):
        predictor = load_predictor("balanced", stack, ModelSettings(threads=1))
        if backend is not None:
            predictor.set_backend(backend)
        found: list[Savings] = []

        def trimmed(job: Job, found: list[Savings] = found) -> Job:
            job, savings = trim(job, Scene(stack))
            found.append(savings)
            return job

        layers.append(layers_of(predictor, (pictures[0], pictures[1]), eyes(0.6), changed=trimmed))
        assert 0 < found[0].solved_share < 1
        assert predictor.backend == ("cpu" if backend is None else "gl")
    assert within_one(*layers) >= WITHIN_ONE


@pytest.mark.usefixtures("exactly")
@pytest.mark.parametrize("sigma_mm", [1.0, UNSURE_MM])
@pytest.mark.parametrize("number", range(12))
def test_codes_on_random_pairs(number: int, sigma_mm: float, gl: GlBackend) -> None:
    """Panels, gaps, places and heads of the whole design range."""
    pair = random_still(7, number, width_px=STACK.width_px, height_px=STACK.height_px)
    how: Any = {"sigma_mm": sigma_mm, "fov_deg": pair.fov_deg}
    found = [layers_of(p, pair.images, pair.eyes_m, **how) for p in both("balanced", pair.stack, gl)]
    assert within_one(*found) >= WITHIN_ONE


@pytest.mark.usefixtures("exactly")
@pytest.mark.parametrize("spread_px", [0.4, 0.55, 1.0, 4.0, 8.0])
@pytest.mark.parametrize("name", SHIPPED)
def test_codes_for_eyes_that_are_less_and_more_unsure(name: str, spread_px: float, gl: GlBackend) -> None:
    """On every pixel, and on coarser ones."""
    sigma_mm = spread_px * STACK.width_m / STACK.width_px * 1e3 * 0.6 / 0.06
    pictures = cards(eyes(0.6), STACK)
    found = [layers_of(p, pictures, eyes(0.6), sigma_mm=sigma_mm) for p in both(name, STACK, gl)]
    assert within_one(*found) >= WITHIN_ONE


@pytest.mark.parametrize("sigma_mm", [1.0, UNSURE_MM])
@pytest.mark.parametrize("pose", ["straight", "rolled by 20 degrees", "turned by 30 degrees"])
def test_the_eyes_see_no_less_than_on_the_processor(pose: str, sigma_mm: float, gl: GlBackend) -> None:
    pair = POSES[pose]
    pictures, shown = cards(pair, STACK), []
    for predictor in both("balanced", STACK, gl):
        layers = layers_of(predictor, pictures, pair, sigma_mm=sigma_mm)
        look = displayed(layers, pictures, STACK, eyes_m=pair, fov_deg=FOV_DEG, similarity=False)
        expected = expected_db(look, layers)
        shown.append([look.quality.psnr_db, *(value for value in expected.values() if value is not None)])
    assert len(shown[0]) == 4
    assert (np.array(shown[1]) - shown[0] >= LEAST_DB).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", SHIPPED)
def test_at_1920x1080(name: str, gl: GlBackend, monkeypatch: pytest.MonkeyPatch) -> None:
    stack, pair = replace(STACK, width_px=1920, height_px=1080), eyes(0.6)
    pictures = cards(pair, stack)
    cpu, opengl = both(name, stack, gl)
    found = layers_of(opengl, pictures, pair)
    shown_db = [
        displayed(layers, pictures, stack, eyes_m=pair, fov_deg=FOV_DEG, similarity=False).quality.psnr_db
        for layers in (layers_of(predictor, pictures, pair, refined=True) for predictor in (cpu, opengl))
    ]
    assert abs(shown_db[1] - shown_db[0]) <= 0.05
    hold_exactly(monkeypatch)
    cpu.set_backend(CpuBackend())
    assert within_one(layers_of(cpu, pictures, pair), found) >= WITHIN_ONE


def test_a_panel_wider_than_the_driver_allows_is_refused(gl: GlBackend) -> None:
    widest = int(gl.passes.context.info["GL_MAX_TEXTURE_SIZE"])
    stack = replace(STACK, width_px=widest + 8)
    predictor = load_predictor("fast", STACK)
    assert isinstance(predictor, UnrolledPredictor)
    with pytest.raises(InputError, match=rf"stack: width_px: {widest + 8}: this OpenGL driver allows {widest}"):
        choose("gl", predictor.on_panels(stack), lambda: gl.passes.context)


def test_only_the_network_s_raster_and_the_layers_cross(gl: GlBackend) -> None:
    """Down: what the network looks at, and the layers where arrays are asked for. Up: pictures, and its answer."""
    _, opengl = both("balanced", STACK, gl)
    with counted() as account:
        layers_of(opengl, cards(eyes(0.6), STACK), eyes(0.6))
    assert account.crossed == ["codes up"] * 2 + ["numbers down"] * 2 + ["numbers up"] * 2 + ["codes down"] * 3


@pytest.mark.parametrize("sigma_mm", [0.0, 8.0, UNSURE_MM])
def test_a_gpu_of_200_gigabytes_a_second_has_the_bandwidth_for_60_solutions_at_1920x1080(
    sigma_mm: float, gl: GlBackend
) -> None:
    _, opengl = both("balanced", STACK, gl)
    with counted() as account:
        layers_of(opengl, cards(eyes(0.6), STACK), eyes(0.6), sigma_mm=sigma_mm)
    assert account.bytes * (1920 * 1080) / (STACK.width_px * STACK.height_px) < 200e9 / 60 / 1.5


def test_automatic_takes_the_faster_one_and_says_what_was_measured(gl: GlBackend) -> None:
    choice = choose("auto", load_predictor("fast", STACK), lambda: gl.passes.context)
    assert choice.why.startswith("measured at ")
    cpu_ms, gl_ms = (float(part.split(" ms")[0].split()[-1]) for part in choice.why.split(", "))
    assert choice.backend.name == ("gl" if gl_ms < cpu_ms else "cpu")


def test_without_opengl_automatic_is_the_processor_and_gl_is_refused() -> None:
    def nothing() -> Any:
        raise MissingPart("no OpenGL without a screen")

    predictor = load_predictor("fast", STACK)
    choice = choose("auto", predictor, nothing)
    assert choice.backend.name == "cpu"
    assert "no OpenGL" in choice.why
    with pytest.raises(MissingPart):
        choose("gl", predictor, nothing)


def test_a_model_that_has_one_backend_keeps_it() -> None:
    predictor = load_predictor("sart", STACK)
    assert choose("gl", predictor, offscreen_context).backend.name == predictor.backend == "cpu"


def test_a_lost_context_is_told_and_another_takes_over(gl: GlBackend) -> None:
    pair, lost = eyes(0.6), offscreen_context()
    predictor = load_predictor("fast", STACK)
    predictor.set_backend(GlBackend(lost, STACK))
    before = layers_of(predictor, cards(pair, STACK), pair)
    lost.release()
    with pytest.raises(ContextLost):
        layers_of(predictor, cards(pair, STACK), pair)
    with gl.passes.context:
        predictor.set_backend(gl)
        assert (layers_of(predictor, cards(pair, STACK), pair) == before).all()


def test_nothing_grows_while_a_viewer_walks(gl: GlBackend) -> None:
    _, opengl = both("balanced", STACK, gl)
    places = [eyes(0.5 + 0.01 * step, 0.02 * step, roll_deg=2.0 * step) for step in range(8)]
    for pair in places:
        layers_of(opengl, cards(pair, STACK), pair, sigma_mm=3.0)
    held = [len(state._textures) for state in opengl._states.values()]  # type: ignore[attr-defined]
    targets = len(gl.passes._targets)
    for pair in reversed(places):
        layers_of(opengl, cards(pair, STACK), pair, sigma_mm=3.0)
    assert [len(state._textures) for state in opengl._states.values()] == held  # type: ignore[attr-defined]
    assert len(gl.passes._targets) == targets
    opengl.close()
    assert len(gl.passes._targets) < targets
