"""Measure the time and quality of each saving of the plan, on this machine and scene."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from runtime.content.base import ContentSource
from runtime.evaluation.displayed import displayed
from runtime.evaluation.trials import timed_in_turn
from runtime.model.job import Job
from runtime.model.predictor import Predictor
from runtime.plan.drawing import drawn_job, retina_pictures
from runtime.plan.savings import Measured, Saving
from runtime.records import F64, U8
from runtime.support.progress import tell

REPEATS = 5
MAX_DRIFT_M = 0.001  # of a resting head, before its picture is renewed (`eyes.rest`)


@dataclass(frozen=True, slots=True)
class TrialResult:
    """One way of making the layers."""

    layers: U8
    times_ms: tuple[float, ...]  # render and solve, frame by frame
    psnr_db: float

    @property
    def frame_ms(self) -> float:
        """Time of the median frame."""
        return float(np.median(self.times_ms))


@dataclass(frozen=True, slots=True)
class Measurement:
    """A scene with the plan and without, alternately."""

    numbers: Measured
    with_plan: TrialResult
    without: TrialResult


def measure(predictor: Predictor, content: ContentSource, eyes_m: F64, *, fov_deg: float) -> Measurement:
    """Each saving with and without, for eyes (2, 3)."""

    def psnr_db(layers: U8, at_m: F64) -> float:
        targets = retina_pictures(content, at_m, stack, fov_deg=fov_deg, time_ns=0)
        return displayed(layers, targets, stack, eyes_m=at_m, fov_deg=fov_deg, similarity=False).quality.psnr_db

    count = 0

    def frames(made: Callable[[], Job]) -> Callable[[], U8]:
        def solved() -> U8:
            nonlocal count
            tell("measuring solutions with and without the plan", count, len(ways) * (REPEATS + 1))
            count += 1
            return predictor.solve(made()).layers

        return solved

    stack = predictor.stack
    job = drawn_job(predictor, content, eyes_m, time_ns=0, trimmed=True)
    left_out = job.savings
    ways: Mapping[str, Callable[[], Job]] = {
        "without": lambda: drawn_job(predictor, content, eyes_m, time_ns=0),
        "one channel": lambda: replace(drawn_job(predictor, content, eyes_m, time_ns=0), channels=left_out.channels),
        "with": lambda: drawn_job(predictor, content, eyes_m, time_ns=0, trimmed=True),
    }
    if left_out.channels == 3:
        ways = {name: way for name, way in ways.items() if name != "one channel"}
    calls = {name: frames(way) for name, way in ways.items()}
    done = {
        name: TrialResult(way.answer, way.times_ms, psnr_db(way.answer, eyes_m))
        for name, way in timed_in_turn(calls, runs=REPEATS).items()
    }
    tell("", 0)
    without, with_plan = done["without"], done["with"]
    between = done.get("one channel", without)
    drifted_db = psnr_db(with_plan.layers, eyes_m + np.array([0.0, MAX_DRIFT_M, 0.0]))
    numbers = Measured(
        reuse=Saving(with_plan.frame_ms, with_plan.psnr_db - drifted_db),
        focus=_saving(between, with_plan),
        one_channel=_saving(without, between),
        left_out=left_out,
    )
    return Measurement(numbers, with_plan, without)


def _saving(without: TrialResult, with_it: TrialResult) -> Saving:
    return Saving(without.frame_ms - with_it.frame_ms, without.psnr_db - with_it.psnr_db)
