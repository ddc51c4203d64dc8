"""The body of `phasestack solve`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter_ns
from typing import Any

import cv2
import numpy as np

from runtime.artifacts import OutputFolder, read_image, write_json, write_png
from runtime.config import load_settings, load_stack
from runtime.errors import InputError
from runtime.model.predictor import Prediction, load_predictor
from runtime.model.still import solve_still
from runtime.optics.quality import quality
from runtime.optics.retina import seen_by
from runtime.optics.stack import PanelStack
from runtime.records import F64, U8

SEPARATION_MIN_M = 0.005


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
    tolerance_mm: float | None
    config: Path | None


def solve_pair(request: SolveRequest) -> dict[str, Any]:
    """Layers, what the eyes see of them, and solve.json (design 5.2). Raises InputError."""
    settings = load_settings(request.config)
    model_settings = settings.model
    if request.tolerance_mm is not None:
        model_settings = model_settings.model_copy(update={"tolerance_mm": request.tolerance_mm})
    cv2.setNumThreads(model_settings.threads or -1)
    pictures = [read_image(path) for path in (request.left, request.right)]
    if pictures[0].shape != pictures[1].shape:
        sizes = " and ".join(f"{p.shape[1]}x{p.shape[0]}" for p in pictures)
        raise InputError(request.right, "size", f"the two pictures differ: {sizes}")
    height, width = pictures[0].shape[:2]
    stack = load_stack(request.panels, width_px=width, height_px=height)
    if not (math.isfinite(request.fov_deg) and 0 < request.fov_deg < 180):
        raise InputError("solve", "--fov", "must lie between 0 and 180 degrees")
    eyes_m = checked_eyes(request.left_eye, request.right_eye, stack)
    predictor = load_predictor(request.model, stack, model_settings)
    try:
        prediction, timing = _timed(pictures, eyes_m, request, predictor)
        with OutputFolder(request.out) as folder:
            measured = _write(folder.staging, prediction.layers, pictures, eyes_m, stack, request.fov_deg)
            result = measured | timing | {"model": predictor.name, "provider": predictor.provider, "plan": []}
            write_json(folder.staging / "solve.json", result)
    finally:
        predictor.close()
    return result


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


def _timed(
    pictures: list[U8], eyes_m: F64, request: SolveRequest, predictor: Any
) -> tuple[Prediction, dict[str, float]]:
    """A warm-up, then `repeat` timed runs; medians."""
    inference_ms, total_ms = [], []
    prediction = solve_still(*pictures, eyes_m=eyes_m, fov_deg=request.fov_deg, predictor=predictor)
    for _ in range(request.repeat):
        start_ns = perf_counter_ns()
        prediction = solve_still(*pictures, eyes_m=eyes_m, fov_deg=request.fov_deg, predictor=predictor)
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
    size = (stack.width_px, stack.height_px)
    targets, retinas = [], []
    for picture, eye_m, name in zip(pictures, eyes_m, ("left", "right"), strict=True):
        same = (picture.shape[1], picture.shape[0]) == size
        wanted = picture if same else cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
        retina = seen_by(eye_m, layers, stack, fov_deg=fov_deg)
        write_png(folder / f"seen-{name}.png", (np.clip(retina.image, 0, 1) * 255 + 0.5).astype(np.uint8))
        write_png(folder / f"wanted-{name}.png", np.asarray(wanted, np.uint8))
        targets.append(np.asarray(wanted, np.float32) / np.float32(255))
        retinas.append(retina)
    try:
        measured = quality([r.image for r in retinas], targets, [r.mask for r in retinas])
    except ValueError as error:
        raise InputError("solve", "--left-eye", f"{error}: nothing of the display can be seen from there") from None
    return {
        "psnr_db": round(measured.psnr_db, 3),
        "ssim": round(measured.ssim, 4),
        "eye_psnr_db": [round(value, 3) for value in measured.eye_psnr_db],
    }
