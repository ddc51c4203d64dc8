"""The scale by what is known of sensors beforehand and what the pairs tell: two hypotheses, weighed (Bayes).

Beforehand: most sensors have our metre exactly, for all that pairs can tell; the others are off by some 2% (the
setting) or by more, as likely by 4 to 8% as by 8 to 16%. The pairs tell a logarithm of the scale with an estimated
error, so the likelihood is Student's. The answer is the mean of both hypotheses' answers (1, and the fitted scale),
weighed by their probabilities: unlike a test it has no cliff where it jumps from one to the other, and unlike a
normal prior of 2% it does not pull back a sensor that is off by a tenth (45% worse at 10 mm of noise).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from runtime.records import F64

EXACT_SHARE = 0.8
FARTHEST = np.log(10.0)  # a sensor is not off by more than a factor of ten: what the prior is normalised for
MIN_SIGMA = 1e-12  # of the logarithm: exact pairs
REACH = np.sinh(np.linspace(-6.0, 6.0, 161))  # steps of a quadrature, in standard deviations: dense in the middle


@dataclass(frozen=True, slots=True)
class PosteriorScale:
    """What is believed of the scale's logarithm."""

    log_scale: F64  # (...)
    sigma: F64  # (...) its standard deviation


def posterior_scale(log_scale: F64 | float, *, sigma: F64 | float, freedom: int, prior_sigma: float) -> PosteriorScale:
    """From fitted logarithms (...) with estimated standard deviations (...) of `freedom` degrees of freedom.

    prior_sigma: how far off a sensor that is off is at least, in the order of magnitude; above 0.
    """
    fitted = np.asarray(log_scale, dtype=np.float64)[..., None]
    spread = np.maximum(np.asarray(sigma, dtype=np.float64), MIN_SIGMA)[..., None]
    exact = EXACT_SHARE * student.pdf(fitted / spread, freedom) / spread
    places = np.sort(
        np.concatenate(np.broadcast_arrays(fitted + spread * REACH, prior_sigma * REACH + 0 * fitted), axis=-1), axis=-1
    )
    density = student.pdf((places - fitted) / spread, freedom) / spread / (prior_sigma + np.abs(places))
    density *= (1 - EXACT_SHARE) / (2 * np.log1p(FARTHEST / prior_sigma))
    off = np.trapezoid(density, places, axis=-1)
    # Exact pairs far from 1 leave both hypotheses no density that a float can hold: the data have decided.
    total = np.maximum(exact[..., 0] + off, np.finfo(float).tiny)
    chance = np.asarray(exact[..., 0] / total)
    mean = (1 - chance) * fitted[..., 0]
    variance = (1 - chance) * (spread[..., 0] ** 2 + chance * fitted[..., 0] ** 2)
    return PosteriorScale(mean, np.sqrt(variance))
