"""Compute a calibration file from pairs, and compare all methods (`calibrate solve`)."""

from __future__ import annotations

import datetime
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tomlkit

from calib.checks import check_pairs, check_solution
from calib.config_file import save
from calib.pairs import Pairs, read_pairs
from calib.similarity import Degenerate
from calib.solution import METHODS, CalibrationSolution, solve, solve_default
from calib.viewpoints import viewing_volume_m
from runtime.config import Settings
from runtime.errors import InputError
from runtime.records import F64

if TYPE_CHECKING:
    from tomlkit.items import Array

STORED_PAIRS = 500  # the calibration file contains the pairs if there are at most this many


def solve_file(
    pairs_path: Path, out: Path, *, settings: Settings, method: str = "", known_scale: float = 1.0
) -> dict[str, Any]:
    """Compute a calibration from a file of pairs and write it; the version it replaces is kept. Without a
    method, it is the one with the least expected error at the eye. `known_scale` is for `fixed-scale`. Raises
    InputError if the pairs cannot be read or do not determine the calibration, or the method is unknown.
    """
    if method and method not in METHODS:
        raise InputError("calibrate solve", "--method", f"must be one of {', '.join(METHODS)}, not {method}")
    pairs = read_pairs(pairs_path)
    warnings = check_pairs(pairs)
    volume_m = viewing_volume_m(settings.calibration)
    try:
        chosen = (
            solve(pairs.sensor_m, pairs.stack_m, method=method, known_scale=known_scale, reason="as requested")
            if method
            else solve_default(pairs.sensor_m, pairs.stack_m)
        )
    except Degenerate as problem:
        raise InputError(pairs.source, "pairs", str(problem)) from None
    warnings += check_solution(pairs, chosen, volume_m)
    methods = []
    for name in METHODS:
        with suppress(Degenerate):
            other = solve(pairs.sensor_m, pairs.stack_m, method=name, known_scale=known_scale)
            methods.append(_figures(chosen if name == chosen.method else other, volume_m))
    save(out, calibration_text(chosen, pairs, settings, warnings=warnings, volume_m=volume_m))
    return _figures(chosen, volume_m) | {
        "file": str(out),
        "reason": chosen.reason,
        "stack_from_sensor": chosen.similarity.matrix,
        "pairs": len(pairs),
        "axis_rms_mm": chosen.axis_rms_m * 1e3,
        "outliers": [pairs.names[i] for i in np.flatnonzero(~chosen.used)],
        "warnings": warnings,
        "methods": methods,
    }


def _figures(solution: CalibrationSolution, volume_m: F64) -> dict[str, Any]:
    error_m = solution.eye_error_m(volume_m)
    return {
        "method": solution.method,
        "scale": float(solution.similarity.scale),
        "rms_mm": solution.rms_m * 1e3,
        "max_mm": solution.max_m * 1e3,
        "eye_error_mm": float(error_m.mean()) * 1e3,
        "eye_error_p95_mm": float(np.percentile(error_m, 95)) * 1e3,
        "condition": solution.condition,
        "rejected": int((~solution.used).sum()),
    }


def calibration_text(
    solution: CalibrationSolution, pairs: Pairs, settings: Settings, *, warnings: list[str], volume_m: F64
) -> str:
    """Format a solution, and its pairs as `[data]`, as a TOML file for `runtime.eyes.calibration`. The
    error at the eye is averaged over `volume_m`, points (..., 3) in `stack`.
    """
    document = tomlkit.document()
    document.add(tomlkit.comment("Written by `phasestack calibrate solve`. Lengths are in metres, angles in radians."))
    document["stack_from_sensor"] = _rows(solution.similarity.matrix)
    document.update({
        "units": "m",
        "method": solution.method,
        "method_reason": solution.reason,
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "sensor_driver": settings.sensor.driver,
        "sensor_serial": pairs.sensor_serial,
        "panel_ids": [panel.edid_serial for panel in settings.output.panels],
        "pairs": int(solution.used.sum()),
        "condition": solution.condition,
        "warnings": warnings,
    })  # fmt: skip
    document["residuals"] = {
        "rms_m": solution.rms_m,
        "max_m": solution.max_m,
        "axis_rms_m": solution.axis_rms_m.tolist(),
        "eye_error_m": float(solution.eye_error_m(volume_m).mean()),
    }
    covariance = tomlkit.table()
    covariance.add(
        tomlkit.comment("Covariance of the rotation vector, shift and log scale about the pivot, in the stack's axes.")
    )
    covariance["pivot_m"] = solution.pivot_m.tolist()
    covariance["matrix"] = _rows(solution.covariance)
    document["covariance"] = covariance
    data: dict[str, Any] = {"source": pairs.source}
    if len(pairs) <= STORED_PAIRS:
        data["names"], data["used"] = list(pairs.names), solution.used.tolist()
        data["sensor_m"], data["stack_m"] = _rows(pairs.sensor_m), _rows(pairs.stack_m)
    document["data"] = data
    return tomlkit.dumps(document)


def _rows(matrix: F64) -> Array:
    rows = tomlkit.array()
    for row in matrix.tolist():
        rows.append(row)
    return rows.multiline(True)
