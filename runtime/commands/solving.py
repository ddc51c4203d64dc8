"""The body of `phasestack solve`."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from runtime.config import ModelSettings, Overrides, changed, load_settings, load_stack
from runtime.content.base import ContentInfo
from runtime.errors import EyesNotServed, InputError
from runtime.evaluation.displayed import EyeViews, Picture, displayed, expected_db
from runtime.evaluation.trials import timed, timed_in_turn
from runtime.model.backends import choose
from runtime.model.predictor import Prediction, Predictor, load_predictor
from runtime.model.schedule import Backend
from runtime.model.still import solve_still
from runtime.optics.carried import intensities
from runtime.optics.retina import as_codes
from runtime.optics.stack import PanelStack
from runtime.plan.planner import focused_part, observed
from runtime.plan.predictors import planned_predictor
from runtime.plan.savings import Measured, Saving, network_items
from runtime.records import F64, U8, PlanItem
from runtime.support.artifacts import OutputFolder, in_8_bits, read_picture, write_json, write_png

SEPARATION_MIN_M = 0.005
MEASURED_FROM = 10  # runs that are worth a look at which backend is faster
COMPARED = 3  # timed runs with and without the plan


@dataclass(frozen=True, slots=True)
class SolveRequest:
    """The command line of `solve`."""

    left: Path
    right: Path
    left_eye: tuple[float, float, float]
    right_eye: tuple[float, float, float]
    fov_deg: float
    panels: Path
    out: Path
    model: str
    repeat: int
    eye_sigma_mm: float
    config: Path | None
    backend: str | None = None
    no_plan: bool = False


def solve_pair(request: SolveRequest) -> dict[str, Any]:
    """Layers, what the eyes see of them, and solve.json (docs/contracts.md). Raises InputError."""
    settings = Overrides(backend=request.backend).applied(load_settings(request.config))
    if request.no_plan:
        settings = changed(settings, "plan", {"enabled": False}, source="--no-plan")
    model_settings = settings.model
    cv2.setNumThreads(model_settings.threads or -1)
    stored = [read_picture(path) for path in (request.left, request.right)]
    pictures = [in_8_bits(picture) for picture in stored]
    if pictures[0].shape != pictures[1].shape:
        sizes = " and ".join(f"{p.shape[1]}x{p.shape[0]}" for p in pictures)
        raise InputError(request.right, "size", f"the two pictures differ: {sizes}")
    height, width = pictures[0].shape[:2]
    stack = load_stack(request.panels, width_px=width, height_px=height)
    eyes_m = checked_eyes(request.left_eye, request.right_eye, stack)
    model_settings = model_settings.model_copy(update={"name": request.model})
    settings = settings.model_copy(update={"model": model_settings})
    predictor = planned_predictor(settings, stack)
    with ExitStack() as contexts, ExitStack() as cleanup:
        cleanup.callback(predictor.close)
        backend = _backend(model_settings, predictor, request, contexts)
        predictor.surround_with(backend)
        prediction, timing = _timed(pictures, eyes_m, request, predictor)
        with OutputFolder(request.out) as folder:
            measured = _write(folder.staging, prediction.layers, stored, eyes_m, stack, request)
            plain = load_predictor(model_settings.name, stack, model_settings)
            cleanup.callback(plain.close)
            plain.surround_with(backend)
            plan = _left_out(pictures, stored, eyes_m, request, predictor, plain, measured["psnr_db"])
            named = {
                "model": predictor.name,
                "provider": predictor.provider,
                "backend": predictor.backend,
                "eye_sigma_mm": request.eye_sigma_mm,
                "plan": [asdict(item) for item in plan],
            }
            result = measured | timing | named
            write_json(folder.staging / "solve.json", result)
    return result


def _backend(settings: ModelSettings, predictor: Predictor, request: SolveRequest, contexts: ExitStack) -> Backend:
    """What surrounds the network: one solution is sooner made than two backends are measured.

    contexts: releases what was made, once nothing uses it any more.
    """

    def context() -> Any:
        from runtime.support.gl import offscreen_context

        made = offscreen_context()
        contexts.callback(made.release)
        return made

    wanted = settings.backend
    if wanted == "auto" and request.repeat < MEASURED_FROM:
        wanted = "opencv"
    return choose(wanted, predictor, context).backend


def _left_out(
    pictures: list[U8],
    stored: Sequence[Picture],
    eyes_m: F64,
    request: SolveRequest,
    predictor: Predictor,
    plain: Predictor,
    planned_db: float,
) -> list[PlanItem]:
    """What the model left out of these pictures, and what that saved and cost against a model that leaves out nothing.

    stored: the same pictures in their files' own bits, which is what the eyes should see.
    Both are timed again, in turn, so that what slows one slows the other.
    """
    numbers = observed(Measured(), predictor)
    info = ContentInfo(request.left.name)
    if not network_items(info, numbers):
        return []
    stack = predictor.stack
    part = focused_part(predictor)
    # In colour, or unfocused, one saving is all there is.
    between = part.whole if part is not None and numbers.channels == 1 and numbers.active_fraction < 1 else None
    ways = {"plain": plain, "planned": predictor} | ({"between": between} if between else {})

    def solved_by(way: Predictor) -> Callable[[int], U8]:
        return lambda _: _solved(pictures, eyes_m, request, way).layers

    calls = {name: solved_by(way) for name, way in ways.items()}
    done = timed_in_turn(calls, runs=COMPARED, keep=lambda layers: layers.copy())
    shown_db = {
        name: planned_db if name == "planned" else _shown(way.answer, stored, eyes_m, stack, request).quality.psnr_db
        for name, way in done.items()
    }

    def saving(without: str, with_it: str) -> Saving:
        return Saving(done[without].median_ms - done[with_it].median_ms, shown_db[without] - shown_db[with_it])

    middle = "between" if between else "plain" if numbers.channels == 3 else "planned"
    numbers = replace(numbers, one_channel=saving("plain", middle), focus=saving(middle, "planned"))
    return network_items(info, numbers)


def checked_eyes(left_eye: tuple[float, ...], right_eye: tuple[float, ...], stack: PanelStack) -> F64:
    """(2, 3) eyes that can be served. Raises InputError, naming the option."""
    for option, eye in (("--left-eye", left_eye), ("--right-eye", right_eye)):
        if not all(math.isfinite(value) for value in eye):
            raise InputError("solve", option, "must be three finite numbers")
        if eye[0] <= max(stack.x_m):
            raise InputError("solve", option, f"x = {eye[0]:g} m : not in front of the panels (x > {max(stack.x_m):g})")
    separation_m = math.dist(left_eye, right_eye)
    if separation_m < SEPARATION_MIN_M:
        raise InputError("solve", "--right-eye", f"is {separation_m * 1e3:g} mm from the left one; 5 mm is the least")
    return np.array([left_eye, right_eye])


def _solved(pictures: list[U8], eyes_m: F64, request: SolveRequest, predictor: Predictor) -> Prediction:
    """Raises InputError for eyes that the model does not serve: here they will not move on."""
    try:
        return solve_still(
            *pictures, eyes_m=eyes_m, fov_deg=request.fov_deg, predictor=predictor, eye_sigma_mm=request.eye_sigma_mm
        )
    except EyesNotServed as error:
        raise InputError(
            "solve", "--left-eye, --right-eye", f"{error}: {predictor.name} can't serve them (try --model sart)"
        ) from None


def _timed(
    pictures: list[U8], eyes_m: F64, request: SolveRequest, predictor: Predictor
) -> tuple[Prediction, dict[str, float]]:
    """A warm-up, then `repeat` timed runs; medians."""
    inference_ms: list[float] = []

    def solved() -> Prediction:
        prediction = _solved(pictures, eyes_m, request, predictor)
        inference_ms.append(prediction.stage_ms["inference"])
        return prediction

    done = timed(solved, runs=request.repeat)
    return done.answer, {
        "inference_ms": round(float(np.median(inference_ms[-request.repeat :])), 3),
        "total_ms": round(done.median_ms, 3),
    }


def _write(
    folder: Path, layers: U8, pictures: Sequence[Picture], eyes_m: F64, stack: PanelStack, request: SolveRequest
) -> dict[str, Any]:
    for n, layer in enumerate(layers):
        write_png(folder / f"layer-{n}.png", layer)
    eye_views = _shown(layers, pictures, eyes_m, stack, request)
    for name, retina, target in zip(("left", "right"), eye_views.seen, eye_views.wanted, strict=True):
        write_png(folder / f"seen-{name}.png", as_codes(retina.image))
        write_png(folder / f"wanted-{name}.png", as_codes(intensities(target)))
    measured = eye_views.quality
    expected = expected_db(eye_views, layers, stack, eyes_m=eyes_m, fov_deg=request.fov_deg)
    return {
        "psnr_db": round(measured.psnr_db, 3),
        "expected_db": {sigma: None if value is None else round(value, 3) for sigma, value in expected.items()},
        "ssim": round(measured.ssim, 4),
        "eye_psnr_db": [round(value, 3) for value in measured.eye_psnr_db],
    }


def _shown(layers: U8, pictures: Sequence[Picture], eyes_m: F64, stack: PanelStack, request: SolveRequest) -> EyeViews:
    """What the eyes see, and what they should see. Raises InputError where they see nothing."""
    try:
        return displayed(layers, pictures, stack, eyes_m=eyes_m, fov_deg=request.fov_deg)
    except ValueError as error:
        raise InputError("solve", "--left-eye", f"{error}: nothing of the display can be seen from there") from None
