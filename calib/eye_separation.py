"""What the eyes' own separation says of the sensor's metre: a ruler that every viewer brings along.

The sensor measures two eyes at every viewpoint. Noise makes their distance larger: of two points with noise of
variance v a coordinate and eye, the mean square distance is d² + 6v, and the distances' variance about 2v. So
d² = mean square - 3 variances, whatever v is. A person's separation is known (a pair of glasses has it) or one of the
population's, 63 ± 3.7 mm (Dodgson 2004, "Variation and extrema of human interpupillary distance": 4,000 adults).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from runtime.records import F64

POPULATION_M, POPULATION_SIGMA_M = 0.063, 0.0037
LEAST_SAMPLES = 5


@dataclass(frozen=True, slots=True)
class SeparationScale:
    """A logarithm of the sensor's scale (metres of `stack` for one of its own), and its standard deviation."""

    log_scale: float
    sigma: float


def separation_scale(separation_m: F64, *, ipd_m: float, ipd_sigma_m: float) -> SeparationScale | None:
    """From the separations (K,) that the sensor told, metres of its own; NaN where it told none.

    ipd_m: the true one; 0: not known, one of the population's. None where too few were measured.
    """
    told = separation_m[np.isfinite(separation_m)]
    if len(told) < LEAST_SAMPLES:
        return None
    known_m, known_sigma_m = (ipd_m, ipd_sigma_m) if ipd_m else (POPULATION_M, POPULATION_SIGMA_M)
    variance = float(told.var(ddof=1))
    square = float((told**2).mean()) - 3 * variance
    if square <= variance:
        return None
    found_m = np.sqrt(square)
    spread = np.sqrt(variance / len(told)) / found_m
    return SeparationScale(float(np.log(known_m / found_m)), float(np.hypot(spread, known_sigma_m / known_m)))


def joined(log_scale: F64 | float, sigma: F64 | float, other: SeparationScale | None) -> tuple[F64, F64]:
    """Two independent estimates of a logarithm of the scale as one: (log_scale, sigma), both (...)."""
    first, spread = np.asarray(log_scale, dtype=np.float64), np.asarray(sigma, dtype=np.float64)
    if other is None:
        return first, spread
    share = other.sigma**2 / (spread**2 + other.sigma**2)
    return share * first + (1 - share) * other.log_scale, spread * np.sqrt(share)
