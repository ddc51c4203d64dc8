"""Measure each saving's effect on time and quality, for a scene on this machine."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from runtime.config import load_settings, with_options
from runtime.content.base import ContentSource
from runtime.content.registry import open_content
from runtime.errors import InputError
from runtime.evaluation.displayed import displayed
from runtime.evaluation.trials import timed_in_turn
from runtime.model.backends import choose
from runtime.model.job import Job
from runtime.model.predictor import Predictor, load_predictor
from runtime.optics.retina import sees_panels
from runtime.optics.stack import PanelStack
from runtime.plan.drawing import drawn_job, retina_pictures
from runtime.plan.savings import Measured, Saving, make_plan
from runtime.records import F64, U8, Eyes
from runtime.support.gl import offscreen_context
from runtime.support.progress import tell

MIDDLE_M = (0.6, 0.0, 0.05)
HALF_IPD_M = 0.031
REPEATS = 5
MAX_DRIFT_M = 0.001  # a resting head may drift this far before its picture is renewed (`eyes.rest`)


class TrialResult(NamedTuple):
    """Time and quality of one way to compute the layers."""

    frame_ms: float  # median time per frame, including drawing
    psnr_db: float  # displayed quality

    def saving_over(self, other: TrialResult) -> Saving:
        """Return the time saved and the quality lost relative to a way that skips less work."""
        return Saving(other.frame_ms - self.frame_ms, other.psnr_db - self.psnr_db)


class Measurement(NamedTuple):
    """Results for a scene with and without the plan. The two trials' runs alternate."""

    numbers: Measured
    with_plan: TrialResult
    without: TrialResult


def measure(predictor: Predictor, content: ContentSource, eyes_m: Eyes, *, fov_deg: float) -> Measurement:
    """Measure a scene with and without each saving; `fov_deg` is that of the pictures used for quality."""
    stack = predictor.stack

    def psnr_db(layers: U8, at_m: F64) -> float:
        targets = retina_pictures(content, at_m, stack, fov_deg=fov_deg, time_ns=0)
        return displayed(layers, targets, stack, eyes_m=at_m, fov_deg=fov_deg, similarity=False).quality.psnr_db

    count = 0

    def layers_of(job: Callable[[], Job]) -> U8:
        nonlocal count
        tell("measuring solutions with and without the plan", count, len(ways) * (REPEATS + 1))
        count += 1
        return predictor.solve(job()).layers

    left_out = drawn_job(predictor, content, eyes_m, time_ns=0, trimmed=True).savings
    ways: dict[str, Callable[[], Job]] = {
        "without": lambda: drawn_job(predictor, content, eyes_m, time_ns=0),
        "one channel": lambda: replace(drawn_job(predictor, content, eyes_m, time_ns=0), channels=left_out.channels),
        "with": lambda: drawn_job(predictor, content, eyes_m, time_ns=0, trimmed=True),
    }
    if left_out.channels == 3:
        del ways["one channel"]
    timed = timed_in_turn({name: partial(layers_of, way) for name, way in ways.items()}, runs=REPEATS)
    tell("", 0)
    done = {
        name: TrialResult(float(np.median(way.times_ms)), psnr_db(way.answer, eyes_m)) for name, way in timed.items()
    }
    without, with_plan = done["without"], done["with"]
    between = done.get("one channel", without)
    drifted_db = psnr_db(timed["with"].answer, eyes_m + np.array([0.0, MAX_DRIFT_M, 0.0]))
    numbers = Measured(
        reuse=Saving(with_plan.frame_ms, with_plan.psnr_db - drifted_db),
        focus=with_plan.saving_over(between),
        one_channel=between.saving_over(without),
        left_out=left_out,
    )
    return Measurement(numbers, with_plan, without)


def plan_for(config: Path | None, *, scene: str | None, model: str | None, scale: float) -> dict[str, Any]:
    """Measure a scene and return the table printed by `phasestack plan`. Scene and model replace those
    configured; `scale` multiplies the panels' rows and columns. Raises PhasestackError if the configuration, the scene
    or the model cannot be used.
    """
    settings = with_options(load_settings(config), scene=scene, model=model)
    cv2.setNumThreads(settings.model.threads or -1)
    stack = settings.stack.stack()
    stack = replace(
        stack, width_px=max(16, round(stack.width_px * scale)), height_px=max(16, round(stack.height_px * scale))
    )
    middle, half = np.array(MIDDLE_M), np.array([0.0, HALF_IPD_M, 0.0])
    eyes_m = np.array(settings.sensor.fixed_eyes_m or [middle - half, middle + half])
    _check_viewer(eyes_m, stack, fov_deg=settings.content.fov_deg)
    with ExitStack() as cleanup:
        context = offscreen_context()
        cleanup.callback(context.release)
        content = open_content(settings.content, stack, context)
        cleanup.callback(content.close)
        predictor = load_predictor(settings.model.name, stack, settings.model)
        backend = choose(settings.model.backend, predictor, lambda: context).backend
        cleanup.callback(backend.close)
        predictor = predictor.bound(backend=backend)
        cleanup.callback(predictor.close)  # must be closed before its backend
        measured = measure(predictor, content, eyes_m, fov_deg=settings.content.fov_deg)
        numbers = measured.numbers
        planned = make_plan(content.info, settings, eyes_m=eyes_m, measured=numbers)
        reused = settings.plan.enabled and not content.info.moving
        drift_db = numbers.reuse.costs_db if reused else None
        return {
            "scene": content.info.name,
            "model": predictor.facts.name,
            "backend": predictor.backend,
            "width_px": stack.width_px,
            "height_px": stack.height_px,
            "plan": [asdict(item) for item in planned.items],
            "active_fraction": round(numbers.left_out.solved_share, 4),
            "channels": numbers.left_out.channels,
            "frame_ms": round(measured.with_plan.frame_ms, 2),
            "frame_ms_without": round(measured.without.frame_ms, 2),
            "psnr_db": round(measured.with_plan.psnr_db, 3),
            "psnr_db_without": round(measured.without.psnr_db, 3),
            "drift_mm": round(1000 * MAX_DRIFT_M, 3),
            "psnr_db_drifted": None if drift_db is None else round(measured.with_plan.psnr_db - drift_db, 3),
        }


def _check_viewer(eyes_m: Eyes, stack: PanelStack, *, fov_deg: float) -> None:
    """Raise InputError if an eye is not in front of the panels or neither eye sees any of the display."""
    nearest_m = float(eyes_m[:, 0].min())
    if nearest_m <= max(stack.x_m):
        raise InputError(
            "sensor.fixed_eyes_m",
            "",
            f"x = {nearest_m:g} m is not in front of the panels; x must exceed {max(stack.x_m):g} m",
        )
    if not any(sees_panels(eye_m, stack, fov_deg=fov_deg) for eye_m in eyes_m):
        raise InputError("sensor.fixed_eyes_m", "", "these eyes cannot see any part of the display")
