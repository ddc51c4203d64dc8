"""Checks of pairs and solutions: unusable data raise InputError, doubtful data return warnings."""

from __future__ import annotations

import numpy as np

from calib.pairs import Pairs
from calib.similarity import Degenerate, Similarity, extents, fit, fit_robust
from calib.solution import CalibrationSolution
from runtime.errors import InputError
from runtime.eyes.calibration import check_similarity
from runtime.records import F64

RESIDUAL_LIMIT_M = 0.05  # as in the EyeReal supplement (figure S5)
SENSOR_NOISE_FLOOR_M = 0.001  # minimum noise assumed, because no depth camera measures a face more accurately
REFUSE_EYE_ERROR_M = 0.05  # expected error at the eye above which a calibration is useless
WARN_EYE_ERROR_M = 0.01  # expected error at the eye above which ghosts are visible
COPLANAR = 0.01  # ratio of the smallest to the largest extent up to which points count as coplanar
MIRROR_GAIN = 0.5  # data count as mirrored if mirroring the sensor's points reduces the error below this share
NAMED = 8  # maximum number of pairs named in a message


def check_pairs(pairs: Pairs) -> list[str]:
    """Check pairs before they are used to compute a calibration, and return warnings. Raises InputError."""
    if _is_mirrored(pairs):
        raise InputError(
            pairs.source,
            "pairs",
            "the sensor and stack frames are mirror images (negative determinant), so an axis points the wrong way; "
            "the sensor's axes must point right, down and away from the camera, and the stack's axes towards the "
            "viewer, right and up",
        )
    try:
        scale = float(fit(pairs.sensor_m, pairs.stack_m, rule="inverse").scale)
    except Degenerate as error:
        raise InputError(pairs.source, "pairs", str(error)) from None
    for wrong, side in ((1e-3, "sensor"), (1e3, "stack")):
        if 0.8 < scale / wrong < 1.25:
            problem = f"must be in metres, but {side} appears to be in millimetres (the scale is {scale:.4g})"
            raise InputError(pairs.source, f"{side}_x", problem)
    first, _, third = extents(pairs.stack_m)
    if third > COPLANAR * first:
        return []
    return ["all viewpoints lie in one plane, so mirrored axes cannot be detected; add a viewpoint outside that plane"]


def check_solution(pairs: Pairs, solution: CalibrationSolution, volume_m: F64) -> list[str]:
    """Check a solution for viewers in a volume spanned by points (..., 3) in `stack`, and return
    warnings. Raises InputError.
    """
    warnings = []
    check_similarity(solution.similarity.matrix, source=pairs.source)
    axis = "xyz"[int(np.argmax(solution.axis_rms_m))]
    if solution.axis_rms_m.max() > RESIDUAL_LIMIT_M:
        hint = "" if solution.method == "robust" else "; if some pairs are wrong, try --method robust"
        raise InputError(
            pairs.source,
            "pairs",
            f"do not fit: the RMS residual along {axis} is {solution.axis_rms_m.max() * 1e3:.0f} mm, "
            f"but the limit is {RESIDUAL_LIMIT_M * 1e3:.0f} mm{hint}",
        )
    noise_m = max(solution.noise_m, SENSOR_NOISE_FLOOR_M)
    error_m = float(solution.eye_error_m(volume_m, noise_m=noise_m).mean())
    if not error_m <= REFUSE_EYE_ERROR_M:
        raise InputError(
            pairs.source,
            "pairs",
            f"do not determine the calibration: {noise_m * 1e3:.1f} mm of noise would shift the eyes by "
            f"{error_m * 1e3:.0f} mm on average (condition number {solution.condition:.3g}); add viewpoints that are "
            "farther apart and not all on one line",
        )
    if error_m > WARN_EYE_ERROR_M:
        warnings.append(
            f"the expected error at the eye is {error_m * 1e3:.0f} mm (condition number {solution.condition:.3g}); "
            "add viewpoints that are farther apart"
        )
    rejected = np.flatnonzero(~solution.used).tolist()
    if rejected:
        warnings.append(f"{_listed(pairs, rejected)}: rejected as outliers")
    beyond = np.flatnonzero(solution.used & (np.abs(solution.residual_m).max(-1) > RESIDUAL_LIMIT_M)).tolist()
    if beyond:
        warnings.append(f"{_listed(pairs, beyond)}: the residual exceeds {RESIDUAL_LIMIT_M * 1e3:.0f} mm")
    scale = float(solution.similarity.scale)
    if not 0.8 <= scale <= 1.25:
        warnings.append(f"the scale is {scale:.5g}, but must be about 1; check that both frames are in metres")
    return warnings


def _listed(pairs: Pairs, index: list[int]) -> str:
    names = [pairs.names[i] for i in index[:NAMED]]
    return ", ".join(names) + (f" and {len(index) - NAMED} more" if len(index) > NAMED else "")


def _is_mirrored(pairs: Pairs) -> bool:
    """Return True if the points are not coplanar and fit far better with the sensor's z axis reversed."""
    if len(pairs) < 4 or extents(pairs.stack_m)[2] <= COPLANAR * extents(pairs.stack_m)[0]:
        return False
    straight = _typical_error_m(pairs.sensor_m, pairs.stack_m)
    mirrored = _typical_error_m(pairs.sensor_m * [1.0, 1.0, -1.0], pairs.stack_m)
    rounding = 1e-9 * float(extents(pairs.stack_m)[0])
    return straight > rounding and mirrored < MIRROR_GAIN * straight


def _typical_error_m(sensor_m: F64, stack_m: F64) -> float:
    try:
        similarity: Similarity = fit_robust(sensor_m, stack_m).similarity
    except Degenerate:
        return float(np.inf)
    return float(np.median(np.sqrt(((similarity.points(sensor_m) - stack_m) ** 2).sum(-1))))
