"""The focused model against the whole one: the same picture for less work. Real scenes, the shipped model."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from runtime.config import Settings
from runtime.content.base import View
from runtime.content.procedural import ProceduralSource
from runtime.content.scenes import Scene, scene
from runtime.model.predictor import Predictor, load_predictor
from runtime.optics.retina import seen_by
from runtime.optics.stack import PanelStack
from runtime.optics.views import image_from_stack
from runtime.plan import measure
from runtime.plan.drawing import raster_views
from runtime.plan.focus import FocusedPredictor
from runtime.plan.measure import displayed_psnr
from runtime.plan.predictors import focused, planned_predictor
from runtime.plan.reduced import ladder_predictor
from runtime.plan.savings import selected_eyes
from runtime.support.gl import offscreen_context

STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 960, 540)
EYES = np.array([[0.6, -0.031, 0.05], [0.6, 0.031, 0.05]])
SETTINGS = Settings()


@pytest.fixture(scope="module")
def gl() -> Any:
    return offscreen_context()


@pytest.fixture
def context(gl: Any) -> Iterator[Any]:
    with gl:
        yield gl


@pytest.fixture(scope="module")
def whole() -> Predictor:
    return load_predictor("fast", STACK, SETTINGS.model)


def part_of(whole: Predictor) -> FocusedPredictor:
    made = focused(whole, SETTINGS.model.model_copy(update={"name": "fast"}))
    assert made is not None
    return made


def draw(source: ProceduralSource, predictor: Predictor, eyes: np.ndarray, *, time_ns: int, aim: bool = True) -> Any:
    """One frame's layers. aim: the predictor is told where the content lies; else it finds that in the pictures."""
    if aim:
        return measure.draw(source, predictor, eyes, time_ns=time_ns)
    images: list[list[Any]] = [[], []]
    for raster in predictor.rasters(eyes):
        for view in raster_views(eyes, raster):
            images[view.side].append(source.render(view, time_ns=time_ns).copy())
    return predictor.predict(images, eyes).layers


def psnr(layers: np.ndarray, source: ProceduralSource, eyes: np.ndarray = EYES) -> float:
    return displayed_psnr(layers.copy(), source, eyes, STACK, fov_deg=40, time_ns=0)


@pytest.mark.parametrize("aim", [True, False], ids=["drawn in the window", "found in the pictures"])
def test_a_sparse_object_looks_the_same_from_a_small_window(context: Any, whole: Predictor, aim: bool) -> None:
    source = ProceduralSource("sparse", stack=STACK, context=context)
    part = part_of(whole)
    without = psnr(draw(source, whole, EYES, time_ns=0), source)
    with_window = psnr(draw(source, part, EYES, time_ns=0, aim=aim), source)
    assert part.active_fraction < 0.2
    assert with_window > without - 0.1


def test_a_flat_scene_is_filled_in_closed_form(context: Any, whole: Predictor) -> None:
    source = ProceduralSource("flat", stack=STACK, context=context)
    part = part_of(whole)
    layers = draw(source, part, EYES, time_ns=0, aim=False)
    assert part.active_fraction == 0.0
    assert psnr(layers, source) > psnr(draw(source, whole, EYES, time_ns=0), source) - 0.1


def test_a_full_picture_goes_through_the_whole_model_unchanged(context: Any, whole: Predictor) -> None:
    source = ProceduralSource("texture", stack=STACK, context=context)
    part = part_of(whole)
    focused_layers = draw(source, part, EYES, time_ns=0).copy()
    assert part.active_fraction == 1.0
    assert (focused_layers == draw(source, whole, EYES, time_ns=0)).all()


def test_nothing_remains_of_an_earlier_window(context: Any, whole: Predictor) -> None:
    """Frames of one moving viewer, drawn by one predictor, equal those of fresh ones."""
    source = ProceduralSource("sparse", stack=STACK, context=context)
    part = part_of(whole)
    for step in (0.0, 0.05, -0.1, 0.2):
        eyes = EYES + np.array([0.0, step, step / 4])
        for aim in (True, False):
            layers = draw(source, part, eyes, time_ns=0, aim=aim).copy()
            fresh = part_of(whole)
            fresh.window = part.window  # a kept window may be larger than a new one's
            again = draw(source, fresh, eyes, time_ns=0, aim=aim)
            assert (layers[..., :3] == again[..., :3]).mean() > 0.9999


@pytest.mark.parametrize("name", ["fast", "balanced", "best"])
def test_there_is_no_seam(context: Any, name: str) -> None:
    """On mid-grey, where the eye is most sensitive, the background errs no more than the whole model's does."""
    source = ProceduralSource("sparse", stack=STACK, context=context, background=(0.5, 0.6, 0.7))
    settings = SETTINGS.model.model_copy(update={"name": name})
    entire = load_predictor(name, STACK, settings)
    part = focused(entire, settings)
    assert part is not None
    worst, mean, quality = [], [], []
    for predictor in (entire, part):
        layers = draw(source, predictor, EYES, time_ns=0).copy()
        quality.append(psnr(layers, source))
        errors = []
        for side, eye in enumerate(EYES):
            projection = image_from_stack(eye, width_px=960, height_px=540, fov_deg=40)
            wanted = source.render(View(eye, side, projection, 960, 540), time_ns=0)
            retina = seen_by(eye, layers, STACK, fov_deg=40)
            background = (wanted[..., 3] == 0) & retina.mask
            errors.append(np.abs(retina.image - wanted[..., :3] / 255.0)[background])
        error = np.concatenate(errors)
        worst.append(error.max())
        mean.append(np.sqrt((error**2).mean()))
    assert part.active_fraction < 0.25
    assert worst[1] < 1.1 * worst[0]
    assert mean[1] < 1.2 * mean[0]
    assert quality[1] > quality[0] - 0.1


@pytest.mark.parametrize("turn", [[0.0, 0.0, 0.0], [0.0, 0.0, 0.02]], ids=["level", "tilted head"])
@pytest.mark.parametrize("at", [(-0.06, 0.02), (0.19, -0.06)], ids=["inside", "at the panel's edge"])
def test_a_window_costs_nothing_wherever_the_object_is(
    context: Any, at: tuple[float, float], turn: list[float]
) -> None:
    thing = replace(scene("sparse").things[0], centre_m=(-0.02, *at))
    source = ProceduralSource(Scene("other", (thing,)), stack=STACK, context=context, background=(0.3, 0.5, 0.4))
    eyes = EYES + np.array([turn, np.zeros(3)])
    entire = load_predictor("balanced", STACK, SETTINGS.model)
    part = focused(entire, SETTINGS.model)
    assert part is not None
    with_window = psnr(draw(source, part, eyes, time_ns=0), source, eyes)
    assert part.active_fraction < 0.5
    assert with_window > psnr(draw(source, entire, eyes, time_ns=0), source, eyes) - 0.1


def test_still_pictures_are_warped_as_the_model_asks() -> None:
    settings = SETTINGS.model.model_copy(update={"name": "best"})
    entire = load_predictor("best", STACK, settings)
    part = focused(entire, settings)
    assert part is not None
    assert part.interpolation == entire.interpolation == "cubic"
    assert part.pre_emphasis == entire.pre_emphasis
    assert part.windows(EYES) == entire.windows(EYES)


def test_one_eye_alone_costs_no_inference(context: Any, whole: Predictor) -> None:
    from runtime.plan.savings import make_plan

    source = ProceduralSource("demo", stack=STACK, context=context)
    aside = np.array([[0.12, 0.42, 0.0], [0.07, 0.50, 0.0]])
    plan = make_plan(source.info, STACK, SETTINGS, eyes_m=aside)
    assert plan.eyes == (True, False)
    part = part_of(whole)
    eyes = selected_eyes(aside, plan.eyes)
    layers = draw(source, part, eyes, time_ns=0, aim=False)
    assert part.active_fraction == 0.0
    assert psnr(layers, source, eyes) > 25


def test_fewer_pixels_are_enlarged_to_the_panels(context: Any) -> None:
    source = ProceduralSource("demo", stack=STACK, context=context)
    full = ladder_predictor("fast", 1.0, STACK, SETTINGS)
    half = ladder_predictor("fast", 0.5, STACK, SETTINGS)
    layers = draw(source, half, EYES, time_ns=0)
    assert layers.shape == (3, 540, 960, 4)
    assert 20 < psnr(layers, source) < psnr(draw(source, full, EYES, time_ns=0), source)


def test_grey_windows_are_solved_in_one_channel(context: Any) -> None:
    source = ProceduralSource(
        Scene("grey", scene("sparse").things, grey=True), stack=STACK, context=context, background=(0.5, 0.5, 0.5)
    )
    planned = planned_predictor(SETTINGS, STACK)
    never = Settings.model_validate({"plan": {"one_channel": False}})
    three = planned_predictor(never, STACK)
    layers = draw(source, planned, EYES, time_ns=0).astype(np.int16)
    assert planned.channels == 1
    difference = np.abs(layers - draw(source, three, EYES, time_ns=0))
    assert three.channels == 3
    assert difference.max() <= 2
    assert (difference > 0).mean() < 0.001


def test_models_that_can_t_be_cut_are_left_whole() -> None:
    stack = replace(STACK, width_px=192, height_px=108)
    assert focused(load_predictor("sart", stack, SETTINGS.model), SETTINGS.model) is None
