"""Calibration methods, their residuals and covariances, and the choice between them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from calib.robust import fit_robust
from calib.similarity import Similarity, fit
from runtime.eyes.calibration import position_jacobian
from runtime.records import F64

Method = Literal["seed", "least-squares", "inverse", "robust", "fixed-scale"]
METHODS: tuple[Method, ...] = get_args(Method)
# Prior of the scale's logarithm: share and standard deviation of three kinds of sensors. They are exact as far as pairs
# can show, off by some percent, or in other units. With these shares, the error exceeds the best method's by at most 4%
# both with a right metre and with one that is off by up to a tenth (tests/calib/test_methods.py). With 0.8 for exact
# sensors, it was by 2% and 6%.
SCALE_PRIOR = np.array([(0.6, 0.0), (0.37, 0.06), (0.03, 1.0)])
MIN_SIGMA = 1e-12  # least sigma of the scale's logarithm, for exact pairs


@dataclass(frozen=True, slots=True)
class CalibrationSolution:
    """Result of one method for K pairs. Parameters and pivot are those of `runtime.eyes.calibration`."""

    method: Method
    similarity: Similarity
    residual_m: F64  # (K, 3) fitted minus known, frame `stack`, all pairs
    used: NDArray[np.bool_]  # (K,) False: rejected as an outlier
    noise_m: float  # standard deviation of one coordinate of the used pairs, in `stack`
    pivot_m: F64  # (3,) frame `stack`: the centre of the used pairs
    unit_covariance: F64  # (7, 7) for noise of 1 m; the scale's row is zero if it is fixed
    condition: float  # condition number of the design, lengths in units of the pairs' RMS radius
    reason: str = ""  # reason for choosing this method

    @property
    def covariance(self) -> F64:
        """(7, 7) of rotation (rad), shift (m) and log scale about the pivot."""
        return self.unit_covariance * self.noise_m**2

    @property
    def rms_m(self) -> float:
        """RMS distance between fitted and known points of the used pairs."""
        return float(np.sqrt((self.residual_m[self.used] ** 2).sum(-1).mean()))

    @property
    def max_m(self) -> float:
        """Largest distance between fitted and known points of the used pairs."""
        return float(np.sqrt((self.residual_m[self.used] ** 2).sum(-1)).max())

    @property
    def axis_rms_m(self) -> F64:
        """(3,) RMS error along x, y, z of the used pairs."""
        return np.asarray(np.sqrt((self.residual_m[self.used] ** 2).mean(0)), dtype=np.float64)

    @property
    def scale_sigma(self) -> float:
        """Standard deviation of the scale's logarithm."""
        return float(np.sqrt(self.covariance[6, 6]))

    def eye_error_m(self, stack_m: F64, *, noise_m: float | None = None) -> F64:
        """(...) expected RMS error at points (..., 3) in `stack`, for the observed noise or `noise_m`."""
        jacobian = position_jacobian(stack_m, pivot_m=self.pivot_m)
        covariance = self.unit_covariance * (self.noise_m if noise_m is None else noise_m) ** 2
        spread: F64 = jacobian @ covariance @ np.swapaxes(jacobian, -1, -2)
        return np.asarray(np.sqrt(np.trace(spread, axis1=-2, axis2=-1)), dtype=np.float64)


def design_covariance(stack_m: F64, *, fixed_scale: bool) -> tuple[F64, F64, float]:
    """Return the (3,) pivot, the (7, 7) covariance for noise of 1 m, and the design's condition number.

    First order, for equal and independent noise in every coordinate; noise in the sensor counts times the scale. A
    design that leaves a parameter undetermined has infinite condition and covariance.
    """
    pivot_m = stack_m.mean(0)
    radius_m = float(np.sqrt(((stack_m - pivot_m) ** 2).sum(-1).mean())) or 1.0
    parameters = 6 if fixed_scale else 7
    jacobian = position_jacobian((stack_m - pivot_m) / radius_m, pivot_m=np.zeros(3))[..., :parameters].reshape(
        -1, parameters
    )
    _, values, axes = np.linalg.svd(np.linalg.qr(jacobian, mode="r"))
    covariance = np.zeros((7, 7))
    if values[-1] <= 1e-14 * values[0]:
        covariance[:parameters, :parameters] = np.inf
        return pivot_m, covariance, float(np.inf)
    units = np.array([1 / radius_m] * 3 + [1.0] * 3 + [1 / radius_m])[:parameters]
    root = (axes.T / values) * units[:, None]
    covariance[:parameters, :parameters] = root @ root.T
    return pivot_m, covariance, float(values[0] / values[-1])


def solve(
    sensor_m: F64, stack_m: F64, *, method: Method, known_scale: float = 1.0, reason: str = ""
) -> CalibrationSolution:
    """Solve (K, 3) pairs by one method, with all error figures. Raises `similarity.Degenerate`."""
    used = np.ones(len(sensor_m), bool)
    if method == "robust":
        robust = fit_robust(sensor_m, stack_m)
        similarity, used = robust.similarity, robust.inlier
    else:
        similarity = fit(sensor_m, stack_m, rule=known_scale if method == "fixed-scale" else method)
    residual_m = similarity.points(sensor_m) - stack_m
    pivot_m, unit_covariance, condition = design_covariance(stack_m[used], fixed_scale=method == "fixed-scale")
    freedom = 3 * int(used.sum()) - (6 if method == "fixed-scale" else 7)
    return CalibrationSolution(
        method=method,
        similarity=similarity,
        residual_m=residual_m,
        used=used,
        noise_m=float(np.sqrt((residual_m[used] ** 2).sum() / freedom)),
        pivot_m=pivot_m,
        unit_covariance=unit_covariance,
        condition=condition,
        reason=reason,
    )


def posterior_scale(fitted: float, *, sigma: float, freedom: int) -> tuple[float, float]:
    """Return the posterior mean and standard deviation of a log scale, over the kinds of sensors.

    The fitted value's error `sigma` is estimated with `freedom` degrees of freedom, hence Student's likelihood.
    Averaging avoids a threshold, and does not correct the scale of a sensor that is off by a tenth.
    """
    shares, widths = SCALE_PRIOR.T
    noise = max(sigma, MIN_SIGMA) ** 2
    spread = np.sqrt(noise + widths**2)
    weights = shares * student.pdf(fitted / spread, freedom) / spread
    weights /= weights.sum()
    trust = (widths / spread) ** 2
    mean = float(weights @ trust) * fitted
    return mean, float(np.sqrt(weights @ (trust * noise + (trust * fitted - mean) ** 2)))


def solve_default(sensor_m: F64, stack_m: F64) -> CalibrationSolution:
    """Solve by the method with the least expected error at the eye (tests/calib/test_methods.py).

    If there are gross errors, this is `robust`. Otherwise it is `fixed-scale` with the posterior mean of the scale,
    which is 1 unless the pairs contradict it. Raises `similarity.Degenerate`.
    """
    robust = solve(sensor_m, stack_m, method="robust")
    rejected = int((~robust.used).sum())
    if rejected:
        return replace(robust, reason=f"{rejected} of {len(sensor_m)} pairs do not agree with the others")
    inverse = solve(sensor_m, stack_m, method="inverse")
    fitted = float(inverse.similarity.scale)
    mean, sigma = posterior_scale(float(np.log(fitted)), sigma=inverse.scale_sigma, freedom=3 * len(sensor_m) - 7)
    scale = float(np.exp(mean))
    solution = solve(
        sensor_m,
        stack_m,
        method="fixed-scale",
        known_scale=scale,
        reason=f"scale {scale:.5g} ± {sigma * scale:.2g} from the fitted {fitted:.5g} ± "
        f"{inverse.scale_sigma * fitted:.2g} and the prior of 1 or off by about {100 * SCALE_PRIOR[1, 1]:g}%",
    )
    unit = solution.unit_covariance.copy()
    # About the pairs' centre the scale is independent of rotation and shift.
    unit[6, 6] = (sigma / solution.noise_m) ** 2 if solution.noise_m > 0 else 0.0
    return replace(solution, unit_covariance=unit)
