"""Load, check and apply calibrations, which relate the sensor frame to the stack frame.

A calibration has seven parameters: a rotation vector (three numbers in rad, about the axes of `stack`), a shift
(three numbers in m) and a log scale. The parameters refer to a pivot w0 in `stack`, the centre of the point pairs used
for calibration, which makes them nearly uncorrelated. A small change d in the parameters moves a point w by

    d_rot × (w - w0) + d_shift + d_scale·(w - w0).
"""

from __future__ import annotations

import datetime
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import ConfigDict, Field

from runtime.config import MOST, Section, read_table, validated
from runtime.errors import InputError
from runtime.records import F64, EyePoints

DEMO_FILE = Path(__file__).parent / "data" / "demo-calibration.toml"
SIMILARITY_TOLERANCE = 1e-3  # relative; accepts a matrix rounded to four digits, but not a sheared one
PLAUSIBLE_SCALE = (0.8, 1.25)  # scale expected between two frames that are both in metres
SCALE = (5e-4, 2e3)  # range of scales that could be explained by millimetres in one point set; others are refused
NEAR_M, MAX_DISTANCE_M = 5.0, 20.0  # warn or refuse, respectively, if the sensor is farther from the display

Number = Annotated[float, Field(strict=True, ge=-MOST, le=MOST)]  # refuses "1.0" and true
Row4 = tuple[Number, Number, Number, Number]
Vector3 = tuple[Number, Number, Number]
Row7 = tuple[Number, Number, Number, Number, Number, Number, Number]


class Lenient(Section):
    """Table that ignores unknown keys, because the file may come from a later version of phasestack."""

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)


class Residuals(Lenient):
    """Table `[residuals]`: distances left between paired points, in metres in the stack frame."""

    rms_m: Annotated[float, Field(ge=0)]


class CovarianceTable(Lenient):
    """Table `[covariance]`: the seven parameters' covariance, and the pivot they refer to."""

    pivot_m: Vector3
    matrix: tuple[Row7, Row7, Row7, Row7, Row7, Row7, Row7]


class CalibrationFile(Lenient):
    """Contents of a calibration file. Only `stack_from_sensor` is required."""

    stack_from_sensor: tuple[Row4, Row4, Row4, Row4]
    units: Literal["m"] = "m"
    method: str = ""
    date: str | datetime.date = ""
    sensor_serial: str = ""  # serial number of the calibrated sensor; empty: any sensor
    condition: Annotated[float, Field(ge=0)] | None = None
    residuals: Residuals | None = None
    covariance: CovarianceTable | None = None


@dataclass(frozen=True, slots=True)
class Calibration:
    """Similarity transform that maps points from the sensor frame to the stack frame."""

    stack_from_sensor: F64  # (4, 4) matrix [sR t; 0 1]
    file: CalibrationFile
    source: str  # file name to use in messages
    warnings: tuple[str, ...]  # lines to show to the user

    @property
    def scale(self) -> float:
        """Number of metres in the stack frame per metre in the sensor frame."""
        return float(np.cbrt(np.linalg.det(self.stack_from_sensor[:3, :3])))

    def points(self, sensor_m: ArrayLike) -> F64:
        """Transform (..., 3) points, in metres, from frame `sensor` to `stack` (EyeReal supplement, (28))."""
        points = np.asarray(sensor_m, dtype=np.float64)
        return points @ self.stack_from_sensor[:3, :3].T + self.stack_from_sensor[:3, 3]

    def apply(self, eyes: EyePoints) -> EyePoints:
        """Transform eye positions and their covariance from the sensor frame to the stack frame."""
        turn, covariance = self.stack_from_sensor[:3, :3], eyes.covariance_m2
        return replace(
            eyes,
            eyes_m=self.points(eyes.eyes_m),
            covariance_m2=None if covariance is None else turn @ covariance @ turn.T,
        )

    def position_error_m(self, stack_m: ArrayLike) -> F64 | None:
        """Return the RMS error in metres at points (..., 3) in `stack`, or None without a covariance."""
        if self.file.covariance is None:
            return None
        jacobian = position_jacobian(stack_m, pivot_m=self.file.covariance.pivot_m)
        spread = jacobian @ np.array(self.file.covariance.matrix) @ np.swapaxes(jacobian, -1, -2)
        error_m: F64 = np.sqrt(np.trace(spread, axis1=-2, axis2=-1))
        return error_m

    def serial_warning(self, serial: str) -> str:
        """One-line warning if a sensor, by its serial number or "", is not the calibrated one, or ""."""
        calibrated = self.file.sensor_serial
        if not calibrated or serial == calibrated:
            return ""
        actual = f"the connected sensor is {serial}" if serial else "the connected sensor reports no serial number"
        return f"{self.source}: the calibration is for sensor {calibrated}, but {actual}; calibrate again"


def position_jacobian(stack_m: ArrayLike, *, pivot_m: ArrayLike) -> F64:
    """Derivatives (..., 3, 7) of points (..., 3) in `stack` with respect to the seven parameters."""
    arm = np.asarray(stack_m, dtype=np.float64) - np.asarray(pivot_m, dtype=np.float64)
    jacobian = np.zeros((*arm.shape, 7))
    jacobian[..., 0, 1], jacobian[..., 0, 2] = arm[..., 2], -arm[..., 1]
    jacobian[..., 1, 0], jacobian[..., 1, 2] = -arm[..., 2], arm[..., 0]
    jacobian[..., 2, 0], jacobian[..., 2, 1] = arm[..., 1], -arm[..., 0]
    jacobian[..., :, 3:6] = np.eye(3)
    jacobian[..., :, 6] = arm
    return jacobian


def similarity_defect(matrix: ArrayLike) -> float:
    """Return max |A^T A / s² - I| of the upper left 3x3 block A with scale s: infinite if it is zero. It
    is 0 for an exact similarity, even one that includes a reflection.
    """
    linear = np.asarray(matrix, dtype=np.float64)[:3, :3]
    largest = float(np.abs(linear).max())
    if not np.isfinite(largest) or largest == 0.0:
        return float("inf")
    gram = (linear / largest).T @ (linear / largest)
    return float(np.abs(gram / (np.trace(gram) / 3) - np.eye(3)).max())


def check_similarity(matrix: F64, *, source: str | Path) -> None:
    """Check that a 4x4 matrix is a plausible calibration. Raises InputError, which names the `source` and
    the field, if it has an entry beyond `MOST` or a wrong last row, is not a similarity, mirrors space, has a scale
    outside `SCALE` or places the sensor beyond `MAX_DISTANCE_M`.
    """
    name = "stack_from_sensor"
    if not np.abs(matrix).max() <= MOST:
        raise InputError(source, name, f"contains a number that exceeds {MOST:g}")
    if not np.array_equal(matrix[3], [0.0, 0.0, 0.0, 1.0]):
        raise InputError(source, name, "must have 0, 0, 0, 1 as its last row")
    defect = similarity_defect(matrix)
    if not defect <= SIMILARITY_TOLERANCE:
        raise InputError(
            source,
            name,
            f"must be a rotation times a single scale to within {SIMILARITY_TOLERANCE}, but is off by {defect:.2g}",
        )
    scale = float(np.linalg.norm(matrix[:3, :3])) / 3**0.5
    if not SCALE[0] <= scale <= SCALE[1]:
        raise InputError(
            source,
            name,
            f"has a scale of {scale:.3g}, but the scale must be about 1; check that both frames are in metres",
        )
    if np.linalg.det(matrix[:3, :3]) < 0.0:
        raise InputError(source, name, "mirrors space (its determinant is negative); check the directions of the axes")
    distance_m = float(np.linalg.norm(matrix[:3, 3]))
    if distance_m > MAX_DISTANCE_M:
        problem = f"places the sensor {distance_m:.4g} m from the display, but the maximum is {MAX_DISTANCE_M:g} m"
        raise InputError(source, name, problem)


def _warnings(matrix: F64, source: str) -> tuple[str, ...]:
    warnings = []
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    if not PLAUSIBLE_SCALE[0] <= scale <= PLAUSIBLE_SCALE[1]:
        reason = "check that both frames are in metres"
        if 800 < scale < 1250 or 0.0008 < scale < 0.00125:
            reason = "one side appears to be in millimetres"
        warnings.append(f"{source}: stack_from_sensor: the scale {scale:.6g} is far from 1; {reason}")
    distance_m = float(np.linalg.norm(matrix[:3, 3]))
    if distance_m > NEAR_M:
        warnings.append(
            f"{source}: stack_from_sensor: the sensor is {distance_m:.3g} m from the display; check this distance"
        )
    return tuple(warnings)


def load_calibration(path: Path | None) -> Calibration:
    """Load and check a calibration file, or the demo recording's. A scale far from 1, or a sensor more
    than `NEAR_M` away, only adds a line to `Calibration.warnings`. Raises InputError, which names file and field, if it
    is missing, malformed, or fails `check_similarity`.
    """
    file = DEMO_FILE if path is None else path
    table = read_table(file)
    if "stack_from_sensor" not in table:
        raise InputError(file, "stack_from_sensor", "is missing; four rows of four numbers are required")
    parsed = validated(CalibrationFile, table, source=file)
    matrix = np.array(parsed.stack_from_sensor, dtype=np.float64)
    check_similarity(matrix, source=file)
    source = "built-in demo" if path is None else str(path)
    return Calibration(matrix, parsed, source, _warnings(matrix, source))


def demo_stack_from_sensor() -> F64:
    """Return the 4x4 calibration for the demo's sensor, which faces +x and is tilted down by 10 degrees."""
    return load_calibration(None).stack_from_sensor


def demo_sensor_from_stack() -> F64:
    """Return the 4x4 inverse of `demo_stack_from_sensor`."""
    return np.asarray(np.linalg.inv(demo_stack_from_sensor()), np.float64)
