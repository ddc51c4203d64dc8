"""Compute a calibration from pairs, estimate its error, and choose the best of several methods."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from calib.similarity import Similarity, fit, fit_robust
from runtime.eyes.calibration import position_jacobian
from runtime.records import F64

Method = Literal["seed", "least-squares", "inverse", "robust", "fixed-scale"]
METHODS: tuple[Method, ...] = get_args(Method)
# Prior for the scale's logarithm: the share and the standard deviation for each of three kinds of sensors. The first
# kind has a scale that is exact as far as pairs can show, the second's scale is off by a few percent, and the third
# uses other units. The resulting error is at most 4% above the best method's, both for an exact scale and for one that
# is off by up to a tenth (tests/calib/test_methods.py). With a share of 0.8 for exact sensors, these figures were 2%
# and 6%.
SCALE_PRIOR = np.array([(0.6, 0.0), (0.37, 0.06), (0.03, 1.0)])
MIN_SIGMA = 1e-12  # minimum standard deviation of the scale's logarithm, for exact pairs


@dataclass(frozen=True, slots=True)
class CalibrationSolution:
    """A calibration computed from K pairs by one method, with its residuals and covariance. The seven
    parameters and the pivot are defined in `runtime.eyes.calibration`.
    """

    method: Method
    similarity: Similarity  # from the `sensor` frame to the `stack` frame
    residual_m: F64  # (K, 3) fitted minus known positions of all pairs, frame `stack`
    used: NDArray[np.bool_]  # (K,) False for pairs that were rejected as outliers
    noise_m: float  # standard deviation, per coordinate, of the used pairs, frame `stack`
    pivot_m: F64  # (3,) centre of the used pairs, frame `stack`
    unit_covariance: F64  # (7, 7) covariance for noise of 1 m, with zeros for a scale that is known exactly
    condition: float  # condition number of the design matrix, with lengths in units of the pairs' RMS radius
    reason: str = ""  # reason for choosing this method

    @property
    def covariance(self) -> F64:
        """Covariance (7, 7) of the rotation vector (rad), the shift (m) and the log scale about the pivot."""
        return self.unit_covariance * self.noise_m**2

    @property
    def rms_m(self) -> float:
        """RMS distance between the fitted and the known points of the used pairs."""
        return float(np.sqrt((self.residual_m[self.used] ** 2).sum(-1).mean()))

    @property
    def max_m(self) -> float:
        """Largest distance between the fitted and the known points of the used pairs."""
        return float(np.sqrt((self.residual_m[self.used] ** 2).sum(-1)).max())

    @property
    def axis_rms_m(self) -> F64:
        """RMS error (3,) of the used pairs along x, y and z."""
        return np.asarray(np.sqrt((self.residual_m[self.used] ** 2).mean(0)), dtype=np.float64)

    @property
    def scale_sigma(self) -> float:
        """Standard deviation of the scale's logarithm."""
        return float(np.sqrt(self.covariance[6, 6]))

    def eye_error_m(self, stack_m: F64, *, noise_m: float | None = None) -> F64:
        """Return the expected RMS error (...) at points (..., 3) in `stack`, in metres. `noise_m` is the
        pairs' deviation per coordinate, by default that observed.
        """
        jacobian = position_jacobian(stack_m, pivot_m=self.pivot_m)
        covariance = self.unit_covariance * (self.noise_m if noise_m is None else noise_m) ** 2
        spread: F64 = jacobian @ covariance @ np.swapaxes(jacobian, -1, -2)
        return np.asarray(np.sqrt(np.trace(spread, axis1=-2, axis2=-1)), dtype=np.float64)


def design_covariance(stack_m: F64, *, fixed_scale: bool) -> tuple[F64, F64, float]:
    """Return the pivot (3,), the covariance (7, 7) for noise of 1 m, and the condition number of points
    (K, 3) in `stack`.

    The covariance is a first-order approximation that assumes equal, independent noise in every coordinate. If the
    noise is given in the sensor frame, multiply it by the scale first. If the points leave a parameter undetermined,
    the covariance and the condition number are infinite. A fixed scale has zero variance.
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
    """Compute a calibration from points (K, 3), measured in `sensor` and known in `stack`, with all its
    error estimates. `known_scale` is for `fixed-scale`; the `reason` for the method is stored. Raises Degenerate as
    `similarity.fit`.
    """
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
    """Return the mean and standard deviation of the log scale's posterior, averaged over the kinds of
    sensors.

    This avoids a threshold between the kinds, and leaves the fitted scale nearly unchanged for a sensor whose scale is
    off by a tenth. `sigma`, of the logarithm `fitted`, was estimated from residuals with `freedom` degrees, which make
    the likelihood a Student's t distribution.
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
    """Compute a calibration from points (K, 3) by the method with the least expected error at the eye.

    If some pairs have gross errors, the method is `robust`. Otherwise it is `fixed-scale` with the scale's posterior
    mean, which is close to 1 unless the pairs contradict that. tests/calib/test_methods.py compares the methods. Raises
    Degenerate as `similarity.fit`.
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
    # Taken about the pairs' centre, the scale is independent of the rotation and the shift.
    unit[6, 6] = (sigma / solution.noise_m) ** 2 if solution.noise_m > 0 else 0.0
    return replace(solution, unit_covariance=unit)
