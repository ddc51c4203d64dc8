"""Implementation of `phasestack solve`."""

from __future__ import annotations

import math
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import typer

from runtime.clock import Stopwatch
from runtime.config import Settings, load_stack, read_table, with_options
from runtime.content.base import ContentInfo
from runtime.content.frames import read_pair
from runtime.errors import EyesNotServed, InputError
from runtime.evaluation.solved import SolvedPair
from runtime.evaluation.trials import timed
from runtime.model.backends import choose
from runtime.model.predictor import Prediction, load_predictor
from runtime.model.still import solve_still
from runtime.optics.cameras import as_cameras, doubts, looking_at_origin
from runtime.optics.disparity import disparity_doubts
from runtime.optics.stack import PanelStack
from runtime.plan.savings import Measured, network_items
from runtime.records import F64
from runtime.report.pairs import StillPair, read_case
from runtime.support.artifacts import OutputFolder, write_json
from runtime.support.gl import offscreen_context
from runtime.support.picture_file import read_image
from runtime.support.progress import tell
from runtime.support.ranges import SEPARATION_MIN_M

MEASURED_FROM = 10  # with fewer runs, timing both backends would take longer than it saves


@dataclass(frozen=True, slots=True)
class Eyes:
    """The eyes or cameras that took the pictures, as given by the options."""

    left: tuple[float, ...] | None  # position in metres in the stack frame; None if given by `cameras`
    right: tuple[float, ...] | None
    fov_deg: float  # the pictures' horizontal field of view
    cameras: Path | None  # file that contains the cameras' matrices


def asked_for(left: Path | None, right: Path | None, layout: str | None, eyes: Eyes, panels: Path | None) -> StillPair:
    """Read a stereo pair, from two files or one with a `layout`, and the panels. Raises InputError."""
    if left is None:
        raise InputError("solve", "--left", "is required without --case; pass the left eye's picture")
    if panels is None:
        raise InputError("solve", "--panels", "is required without --case; pass a file with width_m, height_m and x_m")
    if right is None:
        name, pictures = left.name, list(read_pair(left, with_options(Settings(), layout=layout).content))
    elif layout is not None:
        problem = "cannot be combined with --right; pass one file with both views as --left"
        raise InputError("solve", "--layout", problem)
    else:
        name, pictures = f"{left.name} and {right.name}", [read_image(path) for path in (left, right)]
        if pictures[0].shape != pictures[1].shape:
            sizes = " and ".join(f"{p.shape[1]}x{p.shape[0]}" for p in pictures)
            raise InputError(right, "size", f"the pictures must have the same size, but are {sizes}")
    stack = load_stack(panels, width_px=pictures[0].shape[1], height_px=pictures[0].shape[0])
    pictures, eyes_m, fov_deg = taken(pictures, eyes, stack)
    return StillPair(name, stack, eyes_m, tuple(pictures), fov_deg)


def case_asked_for(case: Path, others: list[str]) -> StillPair:
    """Read a case file. Raises InputError if it is invalid, or with `others`, options that it replaces."""
    if others:
        raise InputError("solve", others[0], "is part of the case file; omit it, or omit --case")
    return read_case(case)


def solve_pictures(
    asked: StillPair,
    out: Path,
    watch: Stopwatch,
    *,
    is_resampled: bool,
    model: str,
    repeat: int,
    eye_sigma_mm: float,
    backend: str | None,
    plan: bool,
    floats: bool,
) -> dict[str, Any]:
    """Solve pictures, write the layers and the eyes' views, and return the contents of solve.json.
    `is_resampled`: they were taken by cameras that are not aimed at the origin. Raises InputError if an option or the
    given eye positions cannot be used.
    """
    pictures, stack, eyes_m, fov_deg = asked.images, asked.stack, asked.eyes_m, asked.fov_deg
    settings = with_options(Settings(), model=model, backend=backend).model
    cv2.setNumThreads(settings.threads)
    for line in doubts(eyes_m, stack, fov_deg=fov_deg, size=(pictures[0].shape[1], pictures[0].shape[0])):
        typer.echo(f"phasestack: {line}", err=True)
    with ExitStack() as contexts, ExitStack() as cleanup:

        def context() -> Any:
            created = offscreen_context()
            contexts.callback(created.release)
            return created

        predictor = load_predictor(model, stack, settings)
        # A few solutions take less time than it would take to time both backends.
        device = "cpu" if settings.backend == "auto" and repeat < MEASURED_FROM else settings.backend
        predictor = predictor.bound(backend=choose(device, predictor, context).backend)
        cleanup.callback(predictor.close)
        watch.lap("load model")
        inference_ms: list[float] = []

        def solve() -> Prediction:
            tell("solving", len(inference_ms), repeat + 1)  # the first run is the warm-up
            prediction = solve_still(
                *pictures,
                eyes_m=eyes_m,
                fov_deg=fov_deg,
                predictor=predictor,
                eye_sigma_mm=eye_sigma_mm,
                trimmed=plan,
                floats=floats,
            )
            inference_ms.append(prediction.stage_ms["inference"])
            return prediction

        try:
            done = timed(solve, runs=repeat)
        except EyesNotServed as error:  # permanent, because the eyes of a still pair do not move
            why = f"{predictor.facts.name} does not support these eye positions ({error}); try --model sart"
            raise InputError("solve", "--left-eye, --right-eye", why) from None
        watch.lap("solve, warm-up included")
        with OutputFolder(out) as folder:
            tell("measuring what the eyes see", 0)
            seen = SolvedPair(done.answer.layers, pictures, stack, eyes_m, fov_deg)
            try:
                quality = seen.quality
            except ValueError as error:
                why = f"this eye cannot see the display: {error}"
                raise InputError("solve", "--left-eye", why) from None
            notes = []
            if len(pictures) == 2:
                notes = disparity_doubts(pictures, eyes_m, stack, fov_deg=fov_deg, parallel=not is_resampled)
            for note in notes:
                typer.echo(f"phasestack: {note}", err=True)
            line = f"{asked.name}, model {predictor.name_with(len(pictures))}, solved for a tracking error of "
            line += f"{eye_sigma_mm:g} mm; PSNR with one ray per pixel, as published: {quality.psnr_db:.1f} dB"
            tell("writing", 0)
            seen.write(folder.staging, lines=[line, *notes], floats=done.answer.floats)
            watch.lap("measure and write")
            items = network_items(ContentInfo(asked.name), Measured(left_out=done.answer.savings))
            result = quality.table() | {
                "inference_ms": round(float(np.median(inference_ms[-repeat:])), 3),
                "total_ms": round(done.median_ms, 3),
                "model": predictor.name_with(len(pictures)),
                "provider": predictor.facts.provider,
                "backend": predictor.backend,
                "eye_sigma_mm": eye_sigma_mm,
                "steps": done.answer.steps + 1,  # the network's initial layers count as one
                "plan": [asdict(item) for item in items],
                "retina_db": None,  # the depth of pictures is unknown
                "notes": notes,
                "wall_s": {part: round(ms / 1e3, 3) for part, ms in watch.stage_ms.items()},
            }
            write_json(folder.staging / "solve.json", result)
            tell("", 0)
    return result


def taken(pictures: list[Any], eyes: Eyes, stack: PanelStack) -> tuple[list[Any], F64, float]:
    """Return the pictures as if taken by eyes that look at the stack's origin, the eyes (2, 3), and the
    fov_deg. Pictures of other cameras (--camera) are resampled. Raises InputError.
    """
    if eyes.cameras is None:
        if eyes.left is None or eyes.right is None:
            raise InputError(
                "solve", "--left-eye, --right-eye", "are required without --camera; pass both positions in metres"
            )
        return pictures, checked_eyes(eyes.left, eyes.right, stack), eyes.fov_deg
    if eyes.left is not None or eyes.right is not None:
        raise InputError("solve", "--camera", "already defines the eye positions; omit --left-eye and --right-eye")
    table = read_table(eyes.cameras)
    try:
        cameras, places_m = as_cameras([table.get("left"), table.get("right")])
        eyes_m = checked_eyes(tuple(places_m[0]), tuple(places_m[1]), stack)
        pictures, fov_deg = looking_at_origin(pictures, cameras, eyes_m, stack)
    except ValueError as error:
        raise InputError(eyes.cameras, "left, right", str(error)) from None
    return pictures, eyes_m, fov_deg


def checked_eyes(left_eye: tuple[float, ...], right_eye: tuple[float, ...], stack: PanelStack) -> F64:
    """Return the eyes (2, 3). Raises InputError if they are not in front, or too close together."""
    for option, eye in (("--left-eye", left_eye), ("--right-eye", right_eye)):
        if eye[0] <= max(stack.x_m):
            raise InputError(
                "solve", option, f"x = {eye[0]:g} m is not in front of the panels; x must exceed {max(stack.x_m):g} m"
            )
    separation_m = math.dist(left_eye, right_eye)
    if separation_m < SEPARATION_MIN_M:
        raise InputError(
            "solve", "--right-eye", f"is {separation_m * 1e3:g} mm from the left eye, but the minimum is 5 mm"
        )
    return np.array([left_eye, right_eye])
