"""A trimmed job against the whole one: the same picture for less work. Real scenes, the shipped models."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from runtime.config import ModelSettings
from runtime.content.base import View
from runtime.content.procedural import ProceduralSource
from runtime.content.scenes import SCENES
from runtime.content.scenes import Scene as Things
from runtime.evaluation.displayed import displayed
from runtime.model.job import Job
from runtime.model.job import drawn_job as drawn_picture_job
from runtime.model.predictor import Predictor, load_predictor
from runtime.model.trim import trim
from runtime.optics.retina import seen_by
from runtime.optics.stack import PanelStack, Tilt
from runtime.optics.views import image_from_stack
from runtime.plan.drawing import drawn_job, raster_views, retina_pictures
from runtime.plan.savings import make_plan, selected_eyes
from runtime.records import F64, U8

STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 960, 540)
EYES = np.array([[0.6, -0.031, 0.05], [0.6, 0.031, 0.05]])


@pytest.fixture(scope="module")
def fast() -> Predictor:
    return load_predictor("fast", STACK)


def trimmed(source: ProceduralSource, predictor: Predictor, eyes: F64 = EYES, *, aim: bool = True, **how: Any) -> Job:
    """aim: the content gives its extent; otherwise it is found in the pictures."""
    if aim:
        return drawn_job(predictor, source, eyes, time_ns=0, trimmed=True, **how)
    pictures = [source.render(view, time_ns=0).copy() for view in raster_views(eyes, STACK.panel(1))]
    return trim(drawn_picture_job(pictures, eyes, STACK), **how)


def psnr(layers: U8, source: ProceduralSource, eyes: F64 = EYES, stack: PanelStack = STACK) -> float:
    targets = retina_pictures(source, eyes, stack, fov_deg=40, time_ns=0)
    return displayed(layers, targets, stack, eyes_m=eyes, fov_deg=40, similarity=False).quality.psnr_db


def compared(
    predictor: Predictor, source: ProceduralSource, eyes: F64 = EYES, **how: Any
) -> tuple[float, float, float]:
    """PSNR of the whole and of the window, and the window's share of the panels."""
    whole = psnr(predictor.solve(drawn_job(predictor, source, eyes, time_ns=0)).layers, source, eyes, predictor.stack)
    job = trimmed(source, predictor, eyes, **how)
    part = psnr(predictor.solve(job).layers, source, eyes, predictor.stack)
    return whole, part, job.savings.solved_share


@pytest.mark.parametrize("aim", [True, False], ids=["drawn in the window", "found in the pictures"])
def test_a_sparse_object_looks_the_same_from_a_small_window(context: Any, fast: Predictor, aim: bool) -> None:
    whole, part, share = compared(fast, ProceduralSource("sparse", stack=STACK, context=context), aim=aim)
    assert share < 0.2
    assert part > whole - 0.35  # gain of steps outside the object


def test_a_flat_scene_is_filled_in_closed_form(context: Any, fast: Predictor) -> None:
    whole, part, share = compared(fast, ProceduralSource("flat", stack=STACK, context=context), aim=False)
    assert share == 0.0
    assert part > whole - 0.35  # gain of steps outside the object


def test_of_a_full_picture_nothing_is_left_out(context: Any, fast: Predictor) -> None:
    job = trimmed(ProceduralSource("texture", stack=STACK, context=context), fast)
    assert job.window is None and job.channels == 3


def test_nothing_remains_of_an_earlier_window(context: Any, fast: Predictor) -> None:
    """Frames of one moving viewer, solved by one predictor, equal those of fresh ones."""
    source, before = ProceduralSource("sparse", stack=STACK, context=context), None
    for step in (0.0, 0.05, -0.1, 0.2):
        eyes = EYES + np.array([0.0, step, step / 4])
        for aim in (True, False):
            job = trimmed(source, fast, eyes, aim=aim, before=before)
            before, layers = job.window, fast.solve(job).layers.copy()
            fresh = load_predictor("fast", STACK)
            assert (layers[..., :3] == fresh.solve(job).layers[..., :3]).all()
            fresh.close()


def test_a_window_that_still_holds_the_difference_is_kept(context: Any, fast: Predictor) -> None:
    source = ProceduralSource("sparse", stack=STACK, context=context)
    first = trimmed(source, fast).window
    second = trimmed(source, fast, EYES + np.array([0.0, 0.002, 0.0]), before=first).window
    assert first is not None and second is not None and first.box == second.box


@pytest.mark.parametrize("name", ["fast", "balanced", "best"])
def test_there_is_no_seam(context: Any, name: str) -> None:
    """On mid-grey, where the eye is most sensitive, the background errs no more than the whole model's does."""
    source = ProceduralSource("sparse", stack=STACK, context=context, background=(0.5, 0.6, 0.7))
    predictor = load_predictor(name, STACK)
    worst, mean, quality = [], [], []
    for job in (drawn_job(predictor, source, EYES, time_ns=0), trimmed(source, predictor)):
        layers = predictor.solve(job).layers.copy()
        quality.append(psnr(layers, source))
        errors = []
        for side, eye in enumerate(EYES):
            projection = image_from_stack(eye, width_px=960, height_px=540, fov_deg=40)
            target = source.render(View(eye, side, projection, 960, 540), time_ns=0)
            retina = seen_by(eye, layers, STACK, fov_deg=40)
            background = (target[..., 3] == 0) & retina.mask
            errors.append(np.abs(retina.image - target[..., :3] / 255.0)[background])
        error = np.concatenate(errors)
        worst.append(error.max())
        mean.append(np.sqrt((error**2).mean()))
    assert job.savings.solved_share < 0.25
    assert worst[1] < 1.1 * worst[0]
    assert mean[1] < 1.2 * mean[0]
    assert quality[1] > quality[0] - 0.25  # gain of the whole outside the object, by steps


@pytest.mark.parametrize("tilted", [False, True], ids=["even panels", "tilted panels"])
@pytest.mark.parametrize("turn", [[0.0, 0.0, 0.0], [0.0, 0.0, 0.02]], ids=["level", "tilted head"])
@pytest.mark.parametrize("at", [(-0.06, 0.02), (0.19, -0.06)], ids=["inside", "at the panel's edge"])
def test_a_window_costs_little_wherever_the_object_is(
    context: Any, at: tuple[float, float], turn: list[float], tilted: bool
) -> None:
    tilt = Tilt(((0.0, 0.005, -0.004), (0.0, 0.0, 0.0), (0.0, -0.004, 0.005)), (0.6, 0.0, 0.0))
    stack = replace(STACK, tilt=tilt) if tilted else STACK
    thing = replace(SCENES["sparse"]().things[0], centre_m=(-0.02, *at))
    source = ProceduralSource(Things("other", (thing,)), stack=stack, context=context, background=(0.3, 0.5, 0.4))
    eyes = EYES + np.array([turn, np.zeros(3)])
    whole, part, share = compared(load_predictor("balanced", stack), source, eyes)
    assert share < 0.5
    assert part > whole - 0.35  # gain of steps outside the object


def test_one_eye_alone_costs_no_inference(context: Any, fast: Predictor) -> None:
    from runtime.config import Settings

    source = ProceduralSource("demo", stack=STACK, context=context)
    aside = np.array([[0.12, 0.42, 0.0], [0.07, 0.50, 0.0]])
    plan = make_plan(source.info, Settings(), eyes_m=aside)
    assert plan.eyes == (True, False)
    eyes = selected_eyes(aside, plan.eyes)
    job = trimmed(source, fast, eyes, aim=False)
    assert job.savings.solved_share == 0.0
    assert psnr(fast.solve(job).layers, source, eyes) > 25


def test_grey_windows_are_solved_in_one_channel(context: Any) -> None:
    source = ProceduralSource(
        Things("grey", SCENES["sparse"]().things, grey=True), stack=STACK, context=context, background=(0.5, 0.5, 0.5)
    )
    predictor = load_predictor("balanced", STACK)
    job = trimmed(source, predictor)
    assert job.channels == 1 and job.savings.solved_share < 0.3
    layers = predictor.solve(job).layers.astype(np.int16)
    difference = np.abs(layers - predictor.solve(replace(job, channels=3)).layers)
    assert difference.max() <= 2
    assert (difference > 0).mean() < 0.0015  # a vector of one channel begins at other pixels than one of three


def test_models_that_can_t_be_cut_are_left_whole(context: Any) -> None:
    stack = replace(STACK, width_px=192, height_px=108)
    sart = load_predictor("sart", stack, ModelSettings())
    assert trimmed(ProceduralSource("sparse", stack=stack, context=context), sart).window is None


def test_after_the_deadline_no_further_step_begins(context: Any, fast: Predictor) -> None:
    """The solution so far is shown: some steps, but not all."""
    source = ProceduralSource("texture", stack=STACK, context=context)
    job = drawn_job(fast, source, EYES, time_ns=0)
    layers, steps = [], []
    for at in (0, 1 << 62, None):
        solved = fast.solve(replace(job, deadline_ns=at))
        layers.append(solved.layers.copy())
        steps.append(solved.steps)
    assert steps[0] == 0 < steps[1] == steps[2]
    shown = [psnr(one, source) for one in layers]
    assert shown[0] < shown[1] - 0.5
    assert shown[1] == shown[2]
    assert shown[0] > 20
