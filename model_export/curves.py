"""The validation curve of a training: a CSV and a picture."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from runtime.support.artifacts import write_bytes, write_text

COLUMNS = ("iteration", "training_loss_db", "held_out_exact_db", "held_out_expected_db", "held_out_loss_db")


@dataclass(frozen=True, slots=True)
class Point:
    """What was measured after some steps."""

    iteration: int
    training_loss_db: float  # mean since the last point; NaN before the first step
    exact_db: float  # displayed PSNR at the eyes, mean over held-out pairs
    expected_db: float  # over each pair's uncertainty, of those that have one
    loss_db: float  # minus what is expected, of all pairs: lower is better

    def row(self) -> tuple[float, ...]:
        """In the order of COLUMNS."""
        return (self.iteration, self.training_loss_db, self.exact_db, self.expected_db, self.loss_db)


def write_curves(out: Path, points: Sequence[Point], *, name: str) -> None:
    """validation.csv and validation.png."""
    lines = [",".join(COLUMNS)]
    lines += [",".join("" if math.isnan(x) else f"{x:.6g}" for x in point.row()) for point in points]
    write_text(out / "validation.csv", "\n".join(lines) + "\n")
    write_bytes(out / "validation.png", _picture(points, name))


def _picture(points: Sequence[Point], name: str) -> bytes:
    figure = Figure(figsize=(8, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    steps = [point.iteration for point in points]
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
    axes.grid(alpha=0.3)
    axes.legend()
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110, metadata={"Software": None})
    return buffer.getvalue()
