"""Measure and compare regression files, which record the shipped models' time, light PSNR and memory.

Run times from different machines can be compared once they are divided by the yardstick, the time taken by a fixed
workload.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from pydantic import BaseModel, Field, PositiveFloat

from runtime.config import StackGeometry, read_table, validated
from runtime.evaluation.trials import timed
from runtime.report.frontier import SHIPPED, Method, MethodResult, measure
from runtime.report.page import describe
from runtime.report.pairs import PairPainter, eyes_at

SIZES = ((960, 540), (1920, 1080))
WORSE_DB = 0.1  # minimum change that is reported; smaller ones can be caused by rounding and thread order
SLOWER = 0.15  # minimum relative change in a time that is reported; larger if the runs scatter
MORE_MEMORY = 0.15  # minimum relative change in memory that is reported
UNSTEADY = 1.3  # maximum ratio between a measurement's yardsticks; above it, the measurement's times are not compared
SCATTERS = 3.0  # a difference between times must exceed this many standard errors of the medians


class BenchEntry(BaseModel):
    """One method's results at one panel size, as a comparison needs them."""

    name: str
    width_px: int
    height_px: int
    ms_p50: PositiveFloat
    scatter: float
    light_db: dict[str, float]
    psnr_db: float
    worst_eye_psnr_db: float
    memory_mib: PositiveFloat

    @property
    def title(self) -> str:
        return f"{self.name} {self.width_px}x{self.height_px}"


class RegressionFile(BaseModel):
    """A regression file's contents, as a comparison needs them."""

    version: Literal[2]
    yardstick_ms: PositiveFloat
    yardsticks_ms: Annotated[list[PositiveFloat], Field(min_length=1)]  # all yardsticks from the measurement
    methods: list[BenchEntry]


def too_busy(yardsticks_ms: Sequence[float]) -> str:
    """Return a message if other load on the machine makes times incomparable, otherwise an empty string."""
    least, most = min(yardsticks_ms), max(yardsticks_ms)
    if most > UNSTEADY * least:
        return f"the same work took {least:.1f} to {most:.1f} ms during the measurement"
    return ""


def read(path: Path) -> RegressionFile:
    """Read a regression file. Raises InputError if the file cannot be read or a field is invalid."""
    return validated(RegressionFile, read_table(path), source=path)


def yardstick_ms() -> float:
    """Return the median of nine times for a fixed workload: image warp, table look-up, matrix product."""
    picture = np.random.default_rng(0).integers(0, 256, (1080, 1920, 4), dtype=np.uint8)
    left = np.random.default_rng(1).random((1080, 240), dtype=np.float32)
    right = np.random.default_rng(2).random((240, 1920), dtype=np.float32)
    matrix = np.array([[1.01, 0.0, 3.3], [0.0, 1.01, 1.7]])
    table = np.arange(256, dtype=np.uint8)[::-1].copy()

    def work() -> None:
        cv2.LUT(cv2.warpAffine(picture, matrix, (1920, 1080)), table)
        _ = left @ right

    return timed(work, runs=9).median_ms


def scatter(values: Sequence[float]) -> float:
    """Return the relative standard error of the median, 1.4826·MAD·1.2533/sqrt(n) over the median."""
    middle = float(np.median(values))
    deviation = float(np.median(np.abs(np.asarray(values) - middle)))
    relative: float = 1.4826 * 1.2533 * deviation / middle / len(values) ** 0.5
    return relative


def measured(
    *,
    models: Sequence[str] = SHIPPED,
    sizes: Sequence[tuple[int, int]] = SIZES,
    progress: Callable[[str], None] = lambda text: None,
) -> dict[str, Any]:
    """Measure the shipped models and return a regression file's contents. Takes a minute."""
    yardsticks, entries = [yardstick_ms()], []
    methods = [Method(name, "network", name) for name in models]
    for width, height in sizes:
        stack = replace(StackGeometry().stack(), width_px=width, height_px=height)
        with PairPainter("demo", stack) as painter:
            pair = painter.pair("demo", eyes_at(distance_m=0.6, height_m=0.05), off_mm=())
        for done, result in measure(methods, [pair]):
            if not isinstance(result, MethodResult):
                raise result
            progress(f"{width}x{height}: finished {done}")
            yardsticks.append(yardstick_ms())
            entries.append(_entry(result))
    return {
        "version": 2,
        "machine": describe(),
        "yardstick_ms": float(np.median(yardsticks)),
        "yardsticks_ms": yardsticks,
        "methods": entries,
    }


def _entry(result: MethodResult) -> dict[str, Any]:
    record = asdict(result)
    del record["pairs"]
    return record | {"scatter": scatter(result.pairs[0].run_ms)}


@dataclass(frozen=True, slots=True)
class Change:
    """A difference between two regression files that exceeds the noise."""

    what: str
    worse: bool
    text: str


def compare(old: RegressionFile, new: RegressionFile) -> list[Change]:
    """Return the changes between two regression files that exceed the noise. Times are divided by their
    file's yardstick before the comparison. They are not compared if the machine was too busy during either measurement
    (`too_busy`).
    """
    later = {entry.title: entry for entry in new.methods}
    machine = new.yardstick_ms / old.yardstick_ms
    comparable = not (too_busy(old.yardsticks_ms) or too_busy(new.yardsticks_ms))
    changes: list[Change] = []
    for before in old.methods:
        name = before.title
        if name not in later:
            changes.append(Change(name, True, "is missing from the new file"))
            continue
        after = later[name]
        if comparable:
            noise = max(SLOWER, SCATTERS * float(np.hypot(before.scatter, after.scatter)))
            ratio = after.ms_p50 / before.ms_p50 / machine
            changes += _times(name, ratio, noise, f"the solution time (noise {noise:.0%})")
        changes += _times(name, after.memory_mib / before.memory_mib, MORE_MEMORY, "the memory")
        for label, gain in _gains(before, after):
            if abs(gain) > WORSE_DB:
                changes.append(Change(name, gain < 0, f"{gain:+.2f} dB {label}"))
    return changes


def _times(name: str, ratio: float, noise: float, of_what: str) -> list[Change]:
    beyond = ratio > 1 + noise or ratio < 1 / (1 + noise)
    return [Change(name, ratio > 1, f"{ratio:.2f} times {of_what}")] if beyond else []


def _gains(before: BenchEntry, after: BenchEntry) -> Iterator[tuple[str, float]]:
    for sigma in sorted(before.light_db.keys() & after.light_db.keys()):
        yield f"of light PSNR at a tracking error of {sigma} mm", after.light_db[sigma] - before.light_db[sigma]
    yield "of PSNR with one ray per pixel", after.psnr_db - before.psnr_db
    yield "of PSNR with one ray per pixel at the worse eye", after.worst_eye_psnr_db - before.worst_eye_psnr_db
