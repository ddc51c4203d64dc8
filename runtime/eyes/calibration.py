"""The calibration from the sensor's frame to the stack's: load, check, apply, and its error.

Parameters of a calibration, about a pivot w0 (the pairs' centre, in `stack`) where they are nearly uncorrelated:
rotation vector (3, rad, about the axes of `stack`), shift (3, m) and log scale (1). A small change d of them moves
a point w by  d_rot × (w - w0) + d_shift + d_scale·(w - w0).
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
SIMILARITY_TOLERANCE = 1e-3  # relative; printed matrices of four digits pass, sheared ones do not
PLAUSIBLE_SCALE = (0.8, 1.25)  # both frames are in metres
SCALE = (5e-4, 2e3)  # beyond: not even millimetres on one side
NEAR_M, MAX_DISTANCE_M = 5.0, 20.0  # of the sensor from the display: farther is odd; no sensor sees a face from there

Number = Annotated[float, Field(strict=True, ge=-MOST, le=MOST)]  # "1.0" and true are not numbers
Row4 = tuple[Number, Number, Number, Number]
Vector3 = tuple[Number, Number, Number]
Row7 = tuple[Number, Number, Number, Number, Number, Number, Number]


class Lenient(Section):
    """A table in which keys of other programs and later versions are left alone."""

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)


class Residuals(Lenient):
    """`[residuals]`: how well the pairs fit the matrix, metres, in `stack`."""

    rms_m: Annotated[float, Field(ge=0)]


class CovarianceTable(Lenient):
    """`[covariance]`: of the parameters in the module's text."""

    pivot_m: Vector3
    matrix: tuple[Row7, Row7, Row7, Row7, Row7, Row7, Row7]


class CalibrationFile(Lenient):
    """A calibration file's tables; only `stack_from_sensor` is required."""

    stack_from_sensor: tuple[Row4, Row4, Row4, Row4]
    units: Literal["m"] = "m"
    method: str = ""
    date: str | datetime.date = ""
    sensor_serial: str = ""  # empty: of no particular device
    condition: Annotated[float, Field(ge=0)] | None = None
    residuals: Residuals | None = None
    covariance: CovarianceTable | None = None


@dataclass(frozen=True, slots=True)
class Calibration:
    """A similarity from `sensor` to `stack`, where it comes from, and how good it is."""

    stack_from_sensor: F64  # (4, 4) [sR t; 0 1]
    file: CalibrationFile  # all that it holds
    source: str  # the file's name, for messages
    warnings: tuple[str, ...]  # what a person should know before trusting it

    @property
    def scale(self) -> float:
        """Metres of `stack` for each metre of `sensor`."""
        return float(np.cbrt(np.linalg.det(self.stack_from_sensor[:3, :3])))

    def points(self, sensor_m: ArrayLike) -> F64:
        """(..., 3) points in `stack`, metres, from (..., 3) points in `sensor` (EyeReal supplement, (28))."""
        points = np.asarray(sensor_m, dtype=np.float64)
        return points @ self.stack_from_sensor[:3, :3].T + self.stack_from_sensor[:3, 3]

    def apply(self, eyes: EyePoints) -> EyePoints:
        """The same eyes in `stack`; `eyes` are in `sensor`."""
        turn, covariance = self.stack_from_sensor[:3, :3], eyes.covariance_m2
        return replace(
            eyes,
            eyes_m=self.points(eyes.eyes_m),
            covariance_m2=None if covariance is None else turn @ covariance @ turn.T,
        )

    def position_error_m(self, stack_m: ArrayLike) -> F64 | None:
        """(...) RMS error, m, of points (..., 3) in `stack` that the calibration alone causes.

        None where that is not known.
        """
        if self.file.covariance is None:
            return None
        jacobian = position_jacobian(stack_m, pivot_m=self.file.covariance.pivot_m)
        spread = jacobian @ np.array(self.file.covariance.matrix) @ np.swapaxes(jacobian, -1, -2)
        error_m: F64 = np.sqrt(np.trace(spread, axis1=-2, axis2=-1))
        return error_m

    def serial_warning(self, serial: str) -> str:
        """One line where a sensor is not the one that was calibrated, else an empty text."""
        own = self.file.sensor_serial
        if not own or serial == own:
            return ""
        found = f"the sensor is {serial}" if serial else "the sensor reports no serial"
        return f"{self.source}: calibrated for sensor {own}, but {found}: calibrate again"


def position_jacobian(stack_m: ArrayLike, *, pivot_m: ArrayLike) -> F64:
    """(..., 3, 7) derivative of points (..., 3) in `stack` by a calibration's parameters about its pivot."""
    arm = np.asarray(stack_m, dtype=np.float64) - np.asarray(pivot_m, dtype=np.float64)
    jacobian = np.zeros((*arm.shape, 7))
    jacobian[..., 0, 1], jacobian[..., 0, 2] = arm[..., 2], -arm[..., 1]
    jacobian[..., 1, 0], jacobian[..., 1, 2] = -arm[..., 2], arm[..., 0]
    jacobian[..., 2, 0], jacobian[..., 2, 1] = arm[..., 1], -arm[..., 0]
    jacobian[..., :, 3:6] = np.eye(3)
    jacobian[..., :, 6] = arm
    return jacobian


def similarity_defect(matrix: ArrayLike) -> float:
    """Distance of the upper left 3x3 from a scaled rotation: max |A^T A / s² - I|.

    0: exactly a similarity (or a reflection of one); infinite for a zero matrix.
    """
    linear = np.asarray(matrix, dtype=np.float64)[:3, :3]
    largest = float(np.abs(linear).max())
    if not np.isfinite(largest) or largest == 0.0:
        return float("inf")
    gram = (linear / largest).T @ (linear / largest)
    return float(np.abs(gram / (np.trace(gram) / 3) - np.eye(3)).max())


def check_similarity(matrix: F64, *, source: str | Path) -> None:
    """Raise InputError, naming the field, for a 4x4 that is no similarity a display can have.

    Its determinant must be positive, its scale within `SCALE`, and the sensor within `MAX_DISTANCE_M`.
    """
    name = "stack_from_sensor"
    if not np.abs(matrix).max() <= MOST:
        raise InputError(source, name, f"has an entry beyond {MOST:g}")
    if not np.array_equal(matrix[3], [0.0, 0.0, 0.0, 1.0]):
        raise InputError(source, name, "its last row must be 0, 0, 0, 1")
    defect = similarity_defect(matrix)
    if not defect <= SIMILARITY_TOLERANCE:
        raise InputError(
            source, name, f"must be rotation times one scale (off by {defect:.2g}, allowed {SIMILARITY_TOLERANCE})"
        )
    largest = float(np.abs(matrix[:3, :3]).max())
    volume = float(np.linalg.det(matrix[:3, :3] / largest))
    if volume <= 0.0:
        raise InputError(source, name, "mirrors space (determinant not positive): check the axes' directions")
    scale = largest * float(np.cbrt(volume))  # of the matrix itself the determinant may leave float64
    if not SCALE[0] <= scale <= SCALE[1]:
        raise InputError(source, name, f"has scale {scale:.3g}: both frames are in metres, it is about 1")
    distance_m = float(np.linalg.norm(matrix[:3, 3]))
    if distance_m > MAX_DISTANCE_M:
        problem = f"puts the sensor {distance_m:.4g} m from the display; at most {MAX_DISTANCE_M:g} m"
        raise InputError(source, name, problem)


def _warnings(matrix: F64, source: str) -> tuple[str, ...]:
    found = []
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    if not PLAUSIBLE_SCALE[0] <= scale <= PLAUSIBLE_SCALE[1]:
        reason = "are both frames in metres?"
        if 800 < scale < 1250 or 0.0008 < scale < 0.00125:
            reason = "millimetres on one side, it seems"
        found.append(f"{source}: stack_from_sensor: scale {scale:.6g} is far from 1: {reason}")
    distance_m = float(np.linalg.norm(matrix[:3, 3]))
    if distance_m > NEAR_M:
        found.append(f"{source}: stack_from_sensor: the sensor is {distance_m:.3g} m from the display: is that so?")
    return tuple(found)


def load_calibration(path: Path | None) -> Calibration:
    """A calibration file, checked; None: the built-in one of the demo recording.

    Raises InputError, naming file and field: missing, malformed, wrong shape, not finite, not a similarity,
    mirrored. A scale far from 1 only warns: `Calibration.warnings`.
    """
    file = DEMO_FILE if path is None else path
    table = read_table(file)
    if "stack_from_sensor" not in table:
        raise InputError(file, "stack_from_sensor", "is missing (four rows of four numbers)")
    parsed = validated(CalibrationFile, table, source=file)
    matrix = np.array(parsed.stack_from_sensor, dtype=np.float64)
    check_similarity(matrix, source=file)
    source = "built-in demo" if path is None else str(path)
    return Calibration(matrix, parsed, source, _warnings(matrix, source))


def demo_stack_from_sensor() -> F64:
    """4x4 rigid transform of the demo's sensor, which looks along +x, tilted down by 10 degrees."""
    return load_calibration(None).stack_from_sensor


def demo_sensor_from_stack() -> F64:
    """4x4 inverse of `demo_stack_from_sensor`."""
    return np.asarray(np.linalg.inv(demo_stack_from_sensor()), np.float64)
