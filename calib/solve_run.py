"""`calibrate solve`: pairs in, a calibration file and the methods' table out."""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import Any

import numpy as np

from calib.checks import check_pairs, check_solution
from calib.pairs import Pairs, read_pairs
from calib.similarity import Degenerate
from calib.solution import METHODS, Solution, solve, solve_default
from calib.store import Origin, calibration_text, save
from calib.viewpoints import viewing_volume_m
from runtime.config import Settings
from runtime.errors import InputError
from runtime.records import F64


def solve_file(
    pairs_path: Path, out: Path, *, settings: Settings, method: str = "", known_scale: float = 1.0
) -> tuple[dict[str, Any], str]:
    """Write the calibration; returns the summary and a table for people. Raises InputError.

    method: empty: the one with the least error at the eye for such pairs; known_scale: of `fixed-scale`.
    """
    if method and method not in METHODS:
        raise InputError("calibrate solve", "--method", f"must be one of {', '.join(METHODS)}, not {method}")
    checked = check_pairs(read_pairs(pairs_path))
    pairs = checked.pairs
    try:
        chosen = (
            solve(pairs.sensor_m, pairs.stack_m, method=method, known_scale=known_scale, reason="asked for")
            if method
            else solve_default(pairs.sensor_m, pairs.stack_m)
        )
    except Degenerate as problem:
        raise InputError(pairs.source, "pairs", str(problem)) from None
    volume_m = viewing_volume_m(settings.calibration)
    warnings = checked.warnings + check_solution(pairs, chosen, volume_m)
    origin = Origin(
        date=datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        sensor_driver=settings.sensor.driver,
        sensor_serial=pairs.sensor_serial,
        panel_ids=tuple(panel.edid_serial for panel in settings.output.panels),
    )
    kept = save(out, calibration_text(chosen, pairs, origin=origin, warnings=warnings, volume_m=volume_m))
    table = [_figures(other, volume_m) for other in _all_methods(pairs, chosen, known_scale=known_scale)]
    summary = _summary(pairs, chosen, warnings, volume_m) | {
        "file": str(out),
        "kept_version": str(kept) if kept else None,
        "methods": table,
    }
    return summary, _text(summary)


def _all_methods(pairs: Pairs, chosen: Solution, *, known_scale: float) -> list[Solution]:
    found = []
    for method in METHODS:
        try:
            found.append(
                chosen
                if method == chosen.method
                else solve(pairs.sensor_m, pairs.stack_m, method=method, known_scale=known_scale)
            )
        except Degenerate:
            continue
    return found


def _figures(solution: Solution, volume_m: F64) -> dict[str, Any]:
    error_m = solution.eye_error_m(volume_m)
    return {
        "method": solution.method,
        "scale": float(solution.similarity.scale),
        "rms_mm": solution.rms_m * 1e3,
        "max_mm": solution.max_m * 1e3,
        "leave_one_out_mm": solution.leave_one_out_rms_m * 1e3,
        "eye_error_mm": float(error_m.mean()) * 1e3,
        "eye_error_p95_mm": float(np.percentile(error_m, 95)) * 1e3,
        "condition": solution.condition,
        "rejected": int((~solution.used).sum()),
    }


def _summary(pairs: Pairs, solution: Solution, warnings: tuple[str, ...], volume_m: F64) -> dict[str, Any]:
    return _figures(solution, volume_m) | {
        "reason": solution.reason,
        "stack_from_sensor": solution.similarity.matrix,
        "pairs": len(pairs),
        "axis_rms_mm": (solution.axis_rms_m * 1e3).tolist(),
        "sigma_rotation_deg": np.degrees(np.sqrt(np.diag(solution.covariance)[:3])).tolist(),
        "sigma_shift_mm": (np.sqrt(np.diag(solution.covariance)[3:6]) * 1e3).tolist(),
        "sigma_scale": solution.scale_sigma,
        "outliers": [pairs.names[i] for i in np.flatnonzero(~solution.used)],
        "warnings": list(warnings),
    }


def _text(summary: dict[str, Any]) -> str:
    lines = [
        f"{summary['file']}: {summary['method']} ({summary['reason']})",
        f"  {summary['pairs']} pairs, {summary['rejected']} rejected; residual RMS {summary['rms_mm']:.2f} mm, "
        f"largest {summary['max_mm']:.2f} mm; x, y, z " + ", ".join(f"{v:.2f}" for v in summary["axis_rms_mm"]) + " mm",
        f"  expected error at the eye {summary['eye_error_mm']:.2f} mm on average over the viewing volume, "
        f"95% below {summary['eye_error_p95_mm']:.2f} mm",
        "",
        "  method         scale     RMS mm   max mm   left out mm   at the eye mm",
    ]
    for row in summary["methods"]:
        mark = ">" if row["method"] == summary["method"] else " "
        lines.append(
            f"{mark} {row['method']:13} {row['scale']:8.5f} {row['rms_mm']:9.3f} {row['max_mm']:8.3f}"
            f" {row['leave_one_out_mm']:13.3f} {row['eye_error_mm']:15.3f}"
        )
    return "\n".join(lines)
