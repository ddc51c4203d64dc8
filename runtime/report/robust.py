"""Robustness: models against a patient iterative solver over many random pairs of the whole design range.

A model fails where it is refused, answers with something that is no number, or shows less than POOR_DB of a pair of
which the reference shows REACHED_DB or more. What the reference cannot show either is the pair's fault.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from runtime.errors import ModelFailure
from runtime.optics.stack import PanelStack
from runtime.records import F64
from runtime.report.eyesight import judged
from runtime.report.methods import Method, opened
from runtime.report.pairs import StillPair
from runtime.support.artifacts import write_bytes

REFERENCE = Method("SART-30", "iterative", "sart", 30)
POOR_DB = 28.0
REACHED_DB = 32.0
Maker = Callable[[int], StillPair]  # a pair of its number alone


@dataclass(frozen=True, slots=True)
class Shown:
    """What one model shows of one pair. NaN throughout where it was refused or answered with no number."""

    psnr_db: float  # both eyes
    worst_eye_db: float
    expected_db: float = float("nan")  # of a pupil: eyes unsure by 1 mm
    problem: str = ""


@dataclass(frozen=True, slots=True)
class Outcome:
    """One pair, and what each model shows of it."""

    number: int
    stack: PanelStack
    eyes_m: F64  # (2, 3) left, right; frame `stack`
    fov_deg: float
    reference: Shown
    models: dict[str, Shown] = field(default_factory=dict)

    def fails(self, model: str) -> bool:
        """True where this model may not do so badly."""
        shown = self.models[model]
        return not np.isfinite(shown.psnr_db) or (shown.psnr_db < POOR_DB and self.reference.psnr_db >= REACHED_DB)

    def record(self) -> dict[str, Any]:
        """As robust.json has it."""
        middle = self.eyes_m.mean(axis=0)
        return {
            "number": self.number,
            "panel_width_m": self.stack.width_m,
            "gap_m": float(np.diff(self.stack.x_m)[0]),
            "distance_m": float(np.linalg.norm(middle)),
            "off_axis_deg": float(np.degrees(np.arccos(middle[0] / np.linalg.norm(middle)))),
            "ipd_m": float(np.linalg.norm(self.eyes_m[1] - self.eyes_m[0])),
            "eyes_m": self.eyes_m,
            "fov_deg": self.fov_deg,
            "reference_db": self.reference.psnr_db,
            "psnr_db": {name: shown.psnr_db for name, shown in self.models.items()},
            "expected_1mm_db": {name: shown.expected_db for name, shown in self.models.items()},
            "worst_eye_db": {name: shown.worst_eye_db for name, shown in self.models.items()},
            "problems": {name: shown.problem for name, shown in self.models.items() if shown.problem},
        }


@dataclass(frozen=True, slots=True)
class Verdict:
    """One model over all pairs."""

    model: str
    median_db: float
    p5_db: float
    least_db: float
    expected_median_db: float  # of a pupil: eyes unsure by 1 mm
    expected_p5_db: float
    beats_reference: float  # the fraction of pairs
    refused: int  # or no number
    failing: list[int]  # numbers of pairs


def outcomes(
    make: Maker,
    numbers: Sequence[int],
    *,
    models: Sequence[str],
    cache: Path,
    threads: int = 2,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> list[Outcome]:
    """Every model on every pair. Pairs and what the reference shows of them are kept in the folder `cache`.

    Raises InputError for an unknown model or a folder that can't be written, before or at the first pair.
    """
    cv2.setNumThreads(threads)
    found = []
    for done, number in enumerate(numbers):
        pair, reference = _kept(make, number, cache, threads)
        shown = {name: _shown(Method(name, "network", name), pair, threads) for name in models}
        found.append(Outcome(number, pair.stack, pair.eyes_m, pair.fov_deg, reference, shown))
        progress(done + 1, len(numbers))
    return found


def verdict(found: Sequence[Outcome], model: str) -> Verdict:
    """The numbers of one model. Raises ValueError without pairs."""
    values = np.array([outcome.models[model].psnr_db for outcome in found])
    reference = np.array([outcome.reference.psnr_db for outcome in found])
    finite = np.isfinite(values)
    median, p5, least = np.percentile(values[finite], (50, 5, 0)) if finite.any() else (np.nan,) * 3
    expected = np.array([outcome.models[model].expected_db for outcome in found])
    expected = expected[np.isfinite(expected)]
    expected_median, expected_p5 = np.percentile(expected, (50, 5)) if expected.size else (np.nan,) * 2
    return Verdict(
        model=model,
        median_db=float(median),
        p5_db=float(p5),
        least_db=float(least),
        expected_median_db=float(expected_median),
        expected_p5_db=float(expected_p5),
        beats_reference=float(np.mean(values > reference)),
        refused=int((~finite).sum()),
        failing=[outcome.number for outcome in found if outcome.fails(model)],
    )


def _shown(method: Method, pair: StillPair, threads: int) -> Shown:
    try:
        layers = opened(method, pair, threads=threads).solve(pair)
        seen = judged(pair, layers)
    except ModelFailure as error:
        return Shown(float("nan"), float("nan"), problem=str(error))
    return Shown(seen.quality.psnr_db, min(seen.quality.eye_psnr_db), seen.expected_db.get("1", float("nan")))


def _kept(make: Maker, number: int, cache: Path, threads: int) -> tuple[StillPair, Shown]:
    path = cache / f"{number}.npz"
    try:
        return _read(path)
    except (OSError, ValueError, KeyError, zipfile.BadZipFile):
        pass  # not there, or cut off: made anew
    pair = make(number)
    reference = _shown(REFERENCE, pair, threads)
    _write(path, pair, reference)
    return pair, reference


def _write(path: Path, pair: StillPair, reference: Shown) -> None:
    buffer = io.BytesIO()
    stack = pair.stack
    np.savez_compressed(
        buffer,
        images=np.stack(pair.images),
        eyes_m=pair.eyes_m,
        size_m=(stack.width_m, stack.height_m),
        x_m=stack.x_m,
        fov_deg=pair.fov_deg,
        reference_db=(reference.psnr_db, reference.worst_eye_db, reference.expected_db),
        name=pair.name,
    )
    write_bytes(path, buffer.getvalue())


def _read(path: Path) -> tuple[StillPair, Shown]:
    with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:  # numpy leaves a broken one open
        left, right = file["images"]
        width_m, height_m = map(float, file["size_m"])
        stack = PanelStack(width_m, height_m, tuple(map(float, file["x_m"])), left.shape[1], left.shape[0])
        pair = StillPair(str(file["name"]), stack, file["eyes_m"], (left, right), float(file["fov_deg"]))
        told = [float(value) for value in file["reference_db"]]
        return pair, Shown(told[0], told[1], told[2] if len(told) > 2 else float("nan"))  # an earlier version kept two
