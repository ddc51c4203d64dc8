"""Calibration files: written atomically, with their past versions beside them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import tomlkit

from calib.pairs import Pairs
from calib.solution import Solution
from runtime.records import F64
from runtime.support import foreign
from runtime.support.artifacts import write_bytes, write_text

if TYPE_CHECKING:
    from tomlkit.items import Array

KEPT_VERSIONS = 20
KEPT_BYTES_MAX = 64 << 20
STORED_PAIRS = 500  # more are left in their own file


@dataclass(frozen=True, slots=True)
class Origin:
    """Where and on what a calibration was made."""

    date: str
    sensor_driver: str = ""
    sensor_serial: str = ""
    panel_ids: tuple[str, ...] = ()


def calibration_text(
    solution: Solution, pairs: Pairs, *, origin: Origin, warnings: tuple[str, ...], volume_m: F64
) -> str:
    """The TOML of a solution; `runtime.eyes.calibration` reads it, `[data]` is the report's."""
    document = tomlkit.document()
    document.add(tomlkit.comment("Made by `phasestack calibrate solve`. Lengths in metres, angles in radians."))
    document["stack_from_sensor"] = _rows(solution.similarity.matrix)
    document["units"] = "m"
    document["method"] = solution.method
    document["method_reason"] = solution.reason
    document["date"] = origin.date
    document["sensor_driver"] = origin.sensor_driver
    document["sensor_serial"] = origin.sensor_serial
    document["panel_ids"] = list(origin.panel_ids)
    document["pairs"] = int(solution.used.sum())
    document["condition"] = float(solution.condition)
    document["warnings"] = list(warnings)
    residuals = tomlkit.table()
    residuals["rms_m"] = solution.rms_m
    residuals["max_m"] = solution.max_m
    residuals["axis_rms_m"] = solution.axis_rms_m.tolist()
    if np.isfinite(solution.leave_one_out_rms_m):
        residuals["leave_one_out_rms_m"] = solution.leave_one_out_rms_m
    residuals["eye_error_m"] = float(solution.eye_error_m(volume_m).mean())
    document["residuals"] = residuals
    covariance = tomlkit.table()
    covariance.add(tomlkit.comment("of rotation vector, shift and log scale about the pivot, in the stack's axes"))
    covariance["pivot_m"] = solution.pivot_m.tolist()
    covariance["matrix"] = _rows(solution.covariance)
    document["covariance"] = covariance
    data = tomlkit.table()
    data["source"] = pairs.source
    if len(pairs) <= STORED_PAIRS:
        data["names"] = list(pairs.names)
        data["used"] = solution.used.tolist()
        data["sensor_m"] = _rows(pairs.sensor_m)
        data["stack_m"] = _rows(pairs.stack_m)
    document["data"] = data
    return tomlkit.dumps(document)


def _rows(matrix: F64) -> Array:
    rows = tomlkit.array()
    for row in matrix.tolist():
        rows.append(row)
    return rows.multiline(True)


def history(path: Path) -> list[Path]:
    """Past versions of a calibration file, oldest first: `NAME.1.toml`, `NAME.2.toml`, ..."""
    pattern = re.compile(re.escape(path.stem) + r"\.(\d+)" + re.escape(path.suffix))
    found = []
    for candidate in path.parent.glob("*"):
        match = pattern.fullmatch(candidate.name)
        if match:
            found.append((int(match[1]), candidate))
    return [file for _, file in sorted(found)]


def save(path: Path, text: str) -> Path | None:
    """Write a calibration atomically; the file it replaces becomes the newest past version, which is returned."""
    kept = None
    if foreign.is_there(path):
        past = history(path)
        number = int(past[-1].stem.rpartition(".")[2]) + 1 if past else 1
        kept = path.with_name(f"{path.stem}.{number}{path.suffix}")
        write_bytes(kept, foreign.read_bytes(path, most_bytes=KEPT_BYTES_MAX))
        for old in past[: max(0, len(past) + 1 - KEPT_VERSIONS)]:
            old.unlink(missing_ok=True)
    write_text(path, text)
    return kept
