"""The body of `phasestack solve`."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from time import perf_counter_ns
from typing import Any

import cv2
import numpy as np

from runtime.config import ModelSettings, load_settings, load_stack
from runtime.content.base import ContentInfo
from runtime.errors import InputError
from runtime.model.predictor import Prediction, Predictor, load_predictor
from runtime.model.still import solve_still
from runtime.optics.quality import Quality, quality
from runtime.optics.retina import Retina, seen_by
from runtime.optics.stack import PanelStack
from runtime.plan.planner import focused_part, observed
from runtime.plan.planning import planned_predictor
from runtime.plan.savings import Measured, Saving, network_items
from runtime.records import F64, U8, PlanItem
from runtime.support.artifacts import OutputFolder, read_image, write_json, write_png

SEPARATION_MIN_M = 0.005
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


def solve_pair(request: SolveRequest) -> dict[str, Any]:
    """Layers, what the eyes see of them, and solve.json (design 5.2). Raises InputError."""
    settings = load_settings(request.config)
    model_settings = settings.model
    cv2.setNumThreads(model_settings.threads or -1)
    pictures = [read_image(path) for path in (request.left, request.right)]
    if pictures[0].shape != pictures[1].shape:
        sizes = " and ".join(f"{p.shape[1]}x{p.shape[0]}" for p in pictures)
        raise InputError(request.right, "size", f"the two pictures differ: {sizes}")
    height, width = pictures[0].shape[:2]
    stack = load_stack(request.panels, width_px=width, height_px=height)
    if not (math.isfinite(request.fov_deg) and 0 < request.fov_deg < 180):
        raise InputError("solve", "--fov", "must lie between 0 and 180 degrees")
    if not math.isfinite(request.eye_sigma_mm):
        raise InputError("solve", "--eye-sigma-mm", "must be a finite number")
    eyes_m = checked_eyes(request.left_eye, request.right_eye, stack)
    model_settings = model_settings.model_copy(update={"name": request.model})
    settings = settings.model_copy(update={"model": model_settings})
    predictor = planned_predictor(settings, stack)
    try:
        prediction, timing = _timed(pictures, eyes_m, request, predictor)
        with OutputFolder(request.out) as folder:
            measured = _write(folder.staging, prediction.layers, pictures, eyes_m, stack, request.fov_deg)
            plan = _left_out(pictures, eyes_m, request, predictor, model_settings, measured["psnr_db"])
            named = {"model": predictor.name, "provider": predictor.provider, "plan": [asdict(item) for item in plan]}
            result = measured | timing | named | {"eye_sigma_mm": request.eye_sigma_mm}
            write_json(folder.staging / "solve.json", result)
    finally:
        predictor.close()
    return result


def _left_out(
    pictures: list[U8],
    eyes_m: F64,
    request: SolveRequest,
    predictor: Predictor,
    settings: ModelSettings,
    planned_db: float,
) -> list[PlanItem]:
    """What the model left out of these pictures, and what that saved and cost against a model that leaves out nothing.

    Both are timed again, in turn, so that what slows one slows the other.
    """
    numbers = observed(Measured(), predictor)
    info = ContentInfo(request.left.name)
    if not network_items(info, numbers):
        return []
    plain = load_predictor(settings.name, predictor.stack, settings)
    part = focused_part(predictor)
    # In colour, or unfocused, one saving is all there is.
    between = part.whole if part is not None and numbers.channels == 1 and numbers.active_fraction < 1 else None
    ways = {"plain": plain, "planned": predictor} | ({"between": between} if between else {})
    times: dict[str, list[float]] = {name: [] for name in ways}
    shown_db = {"planned": planned_db}
    try:
        for turn in range(COMPARED + 1):
            for name, way in ways.items():
                begin_ns = perf_counter_ns()
                solved = _solved(pictures, eyes_m, request, way)
                if turn:
                    times[name].append((perf_counter_ns() - begin_ns) / 1e6)
                elif name != "planned":
                    shown_db[name] = _shown(solved.layers, pictures, eyes_m, predictor.stack, request.fov_deg)[
                        0
                    ].psnr_db
    finally:
        plain.close()

    def saving(without: str, with_it: str) -> Saving:
        saved_ms = float(np.median(times[without]) - np.median(times[with_it]))
        return Saving(saved_ms, shown_db[without] - shown_db[with_it])

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
    return solve_still(
        *pictures, eyes_m=eyes_m, fov_deg=request.fov_deg, predictor=predictor, eye_sigma_mm=request.eye_sigma_mm
    )


def _timed(
    pictures: list[U8], eyes_m: F64, request: SolveRequest, predictor: Any
) -> tuple[Prediction, dict[str, float]]:
    """A warm-up, then `repeat` timed runs; medians."""
    inference_ms, total_ms = [], []
    prediction = _solved(pictures, eyes_m, request, predictor)
    for _ in range(request.repeat):
        start_ns = perf_counter_ns()
        prediction = _solved(pictures, eyes_m, request, predictor)
        total_ms.append((perf_counter_ns() - start_ns) / 1e6)
        inference_ms.append(prediction.stage_ms["inference"])
    return prediction, {
        "inference_ms": round(float(np.median(inference_ms)), 3),
        "total_ms": round(float(np.median(total_ms)), 3),
    }


def _write(
    folder: Path, layers: U8, pictures: list[U8], eyes_m: F64, stack: PanelStack, fov_deg: float
) -> dict[str, Any]:
    for n, layer in enumerate(layers):
        write_png(folder / f"layer-{n}.png", layer)
    measured, seen, wanted = _shown(layers, pictures, eyes_m, stack, fov_deg)
    for name, retina, target in zip(("left", "right"), seen, wanted, strict=True):
        write_png(folder / f"seen-{name}.png", (np.clip(retina.image, 0, 1) * 255 + 0.5).astype(np.uint8))
        write_png(folder / f"wanted-{name}.png", target)
    return {
        "psnr_db": round(measured.psnr_db, 3),
        "ssim": round(measured.ssim, 4),
        "eye_psnr_db": [round(value, 3) for value in measured.eye_psnr_db],
    }


def _shown(
    layers: U8, pictures: list[U8], eyes_m: F64, stack: PanelStack, fov_deg: float
) -> tuple[Quality, list[Retina], list[U8]]:
    """Displayed quality, what the eyes see, and what they should see. Raises InputError where they see nothing."""
    size = (stack.width_px, stack.height_px)
    wanted = [
        picture if picture.shape[1::-1] == size else cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
        for picture in pictures
    ]
    seen = [seen_by(eye_m, layers, stack, fov_deg=fov_deg) for eye_m in eyes_m]
    targets = [np.asarray(picture, np.float32) / np.float32(255) for picture in wanted]
    try:
        measured = quality([retina.image for retina in seen], targets, [retina.mask for retina in seen])
    except ValueError as error:
        raise InputError("solve", "--left-eye", f"{error}: nothing of the display can be seen from there") from None
    return measured, seen, [np.asarray(picture, np.uint8) for picture in wanted]
