"""Write a page with the error at every calibration point and other figures (`calibrate report`)."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import model_validator

from calib.checks import RESIDUAL_LIMIT_M
from calib.viewpoints import viewing_volume_m
from runtime.config import CalibrationSettings, read_table, validated
from runtime.eyes.calibration import Calibration, Lenient, Vector3, load_calibration, similarity_defect
from runtime.records import F64
from runtime.report.page import Figure, Page, PageSection, Table, drawing, png
from runtime.support.figures import in_words

COLOURS = {"X": "#c0392b", "Y": "#27803b", "Z": "#2260a8"}


class StoredPairs(Lenient):
    """The `[data]` table of a calibration file, with the pairs used to compute the calibration."""

    sensor_m: tuple[Vector3, ...]  # measured positions, frame `sensor`
    stack_m: tuple[Vector3, ...]  # known positions, frame `stack`
    used: tuple[bool, ...]  # False for pairs that were rejected as outliers
    names: tuple[str, ...]

    @model_validator(mode="after")
    def _fit_together(self) -> StoredPairs:
        sizes = {len(column) for column in (self.sensor_m, self.stack_m, self.used, self.names)}
        if len(sizes) > 1:
            raise ValueError("names, used, sensor_m and stack_m differ in length")
        if not any(self.used):
            raise ValueError("used is true for no pair, but a calibration is computed from pairs")
        return self


class Points(NamedTuple):
    """A calibration's errors at the pairs used to compute it."""

    names: tuple[str, ...]
    residual_m: F64  # (K, 3) calibrated minus true positions, frame `stack`
    used: NDArray[np.bool_]  # (K,) False for pairs that were rejected as outliers


def write_report(file: Path, out: Path, *, viewing: CalibrationSettings) -> dict[str, Any]:
    """Write a page about a calibration, with its plots as PNG files and its figures in `report.json`, and
    return these. The error at the eye is averaged over the `viewing` range. Raises InputError.
    """
    calibration, table = load_calibration(file), read_table(file)
    points = _stored_points(table.get("data"), calibration, source=file)
    summary = _summary(calibration, points, viewing_volume_m(viewing))
    rows = [[name, text] for name, value in summary.items() if (text := in_words(value))]
    sections = [PageSection("Numbers", tables=[Table(["", ""], rows)])]
    notes = [*calibration.warnings]
    if isinstance(table.get("warnings"), list):
        notes += [str(text) for text in table["warnings"]]
    if points is None:
        notes.append("This file contains no pairs, or too many, so the error of each point is unknown.")
    else:
        text = "X, Y and Z error of every calibration point (the EyeReal supplement's figure S5)"
        figure = Figure("residuals", residual_figure(points, limit_m=RESIDUAL_LIMIT_M), text)
        sections += [PageSection("Pictures", figures=[figure]), PageSection("Points", tables=[_point_table(points)])]
    if calibration.file.covariance is None:
        notes.append("This file contains no covariance, so the error at the eye is unknown.")
    lead = "Pose of the depth camera relative to the stack of panels, with its uncertainty."
    Page(f"Calibration {file.name}", lead, sections, notes=notes).write(out, data=summary)
    return summary


def _stored_points(data: Any, calibration: Calibration, *, source: Path) -> Points | None:
    """Return the errors of the pairs in a file's `[data]`, or None. Raises InputError if it is invalid."""
    if not isinstance(data, dict) or "sensor_m" not in data:
        return None
    found = validated(StoredPairs, data, source=f"{source}: data")
    return Points(found.names, calibration.points(found.sensor_m) - found.stack_m, np.array(found.used))


def residual_figure(points: Points, *, limit_m: float) -> bytes:
    """Plot every point's errors in mm, as EyeReal's figure S5, with lines at `limit_m`; return a PNG."""
    residual_m, used = points.residual_m, points.used
    with drawing(9, 6.5) as canvas:
        axes = canvas.subplots(nrows=3, sharex=True, sharey=True)
        numbers = np.arange(1, len(residual_m) + 1)
        largest = 1e3 * max(float(np.abs(residual_m[used]).max(initial=0.0)), 1e-6)
        for panel, (name, colour), values in zip(axes, COLOURS.items(), residual_m.T * 1e3, strict=True):
            shown = np.clip(values, -2 * largest, 2 * largest)
            panel.vlines(numbers[used], 0, shown[used], color=colour, linewidth=2, label="used")
            panel.vlines(numbers[~used], 0, shown[~used], color="#bbbbbb", linewidth=2,
                         label="rejected (may be outside the plot)")  # fmt: skip
            rms = float(np.sqrt((values[used] ** 2).mean()))
            panel.axhline(0, color="#222222", linewidth=0.8)
            panel.set(ylabel=f"{name} error (mm)", title=f"{name}: RMS {rms:.2f} mm")
            if limit_m * 1e3 < 2 * largest:
                for limit_mm in (-limit_m * 1e3, limit_m * 1e3):
                    panel.axhline(limit_mm, color="#c0392b", linestyle="--", linewidth=0.8)
        if (~used).any():
            axes[0].legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, fontsize=8, frameon=False)
        axes[-1].set_xlabel("calibration point")
        canvas.suptitle("Calibrated minus true position of each point", fontsize=11)
        return png(canvas)


def _summary(calibration: Calibration, points: Points | None, volume_m: F64) -> dict[str, Any]:
    """Return the contents of `report.json`, with None for unknown values."""
    found: dict[str, Any] = {
        "method": calibration.file.method,
        "date": str(calibration.file.date),
        "sensor_serial": calibration.file.sensor_serial,
        "scale": calibration.scale,
        "similarity_defect": similarity_defect(calibration.stack_from_sensor),
        "condition": calibration.file.condition,
    }
    if points is not None:
        residual_m = points.residual_m[points.used]
        distance_m = np.linalg.norm(residual_m, axis=-1)
        found |= {
            "points": len(points.names),
            "rejected": int((~points.used).sum()),
            "rms_mm": float(np.sqrt((distance_m**2).mean())) * 1e3,
            "max_mm": float(distance_m.max()) * 1e3,
            "axis_rms_mm": (np.sqrt((residual_m**2).mean(axis=0)) * 1e3).tolist(),
        }
    eye_error = calibration.position_error_m(volume_m)
    found["eye_error_mm"] = None if eye_error is None else float(eye_error.mean()) * 1e3
    found["eye_error_p95_mm"] = None if eye_error is None else float(np.percentile(eye_error, 95)) * 1e3
    return found


def _point_table(points: Points) -> Table:
    rows = []
    for number, (name, error, used) in enumerate(zip(points.names, points.residual_m * 1e3, points.used, strict=True)):
        cells = [f"{value:.2f}" for value in (*error, np.linalg.norm(error))]
        rows.append([str(number + 1), name, *cells, "" if used else "rejected"])
    return Table(["", "point", "X error, mm", "Y error, mm", "Z error, mm", "distance, mm", ""], rows)
