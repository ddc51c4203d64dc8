"""The validation curve of a training: a CSV and a picture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from pathlib import Path

from runtime.report.plots import drawing, png
from runtime.support.artifacts import write_bytes, write_text

COLUMNS = ("iteration", "training_loss_db", "held_out_exact_db", "held_out_expected_db", "held_out_loss_db")


@dataclass(frozen=True, slots=True)
class Point:
    """What was measured after some steps, in the order of COLUMNS."""

    iteration: int
    training_loss_db: float  # mean since the last point; NaN before the first step
    exact_db: float  # displayed PSNR at the eyes, mean over held-out pairs
    expected_db: float  # over each pair's uncertainty, of those that have one
    loss_db: float  # minus what is expected, of all pairs: lower is better


def write_curves(out: Path, points: Sequence[Point], *, name: str) -> None:
    """validation.csv and validation.png."""
    lines = [",".join(COLUMNS)]
    lines += [",".join("" if math.isnan(x) else f"{x:.6g}" for x in astuple(point)) for point in points]
    write_text(out / "validation.csv", "\n".join(lines) + "\n")
    write_bytes(out / "validation.png", _picture(points, name))


def _picture(points: Sequence[Point], name: str) -> bytes:
    steps = [point.iteration for point in points]
    with drawing(8, 4.2) as figure:
        axes = figure.add_subplot()
        axes.plot(steps, [point.exact_db for point in points], "o-", label="at the eyes")
        axes.plot(
            steps,
            [point.expected_db for point in points],
            "s-",
            label="expected, by each pair's uncertainty (pairs that have one)",
        )
        axes.plot(steps, [-point.loss_db for point in points], "^--", label="expected, all pairs (minus the loss)")
        axes.set(xlabel="steps of the optimiser", ylabel="displayed PSNR, dB (higher is better)")
        axes.set_title(f"Training {name}: mean over held-out procedural pairs")
        axes.legend()
        return png(figure)
