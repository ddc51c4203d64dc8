"""A panel's grey curve: from the luminances of some greys to phase against grey, and its inverse, the LUT.

Between crossed polarizers, with the other panels at zero, a panel of phase p shows L = dark + range·sin²(pi/2·p)
(EyeReal, (4)). Either the phase or the intensity sin²(pi/2·p) is modelled as B(g^gamma), whichever explains the series
with fewer parameters: a bare panel is smooth in the one, a monitor with its own tone curve in the other. B is a
polynomial in Bernstein form whose coefficients ascend from 0 to 1: monotone and smooth whatever the noise. Dark and
range are fitted too. That full white is a phase of 1 is assumed: luminance alone cannot tell a panel that does not
reach it.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import BPoly, PchipInterpolator
from scipy.optimize import least_squares

from runtime.optics.malus import intensity_from_phase, phase_from_intensity
from runtime.records import F64
from runtime.support.artifacts import write_text

MAX_DEGREE = 6
LUT_ROWS = 256
EXACT = 1e-14  # mean square, of the range, below which a fit cannot be bettered


@dataclass(frozen=True, slots=True)
class GreyCurve:
    """Phase against grey of one panel."""

    of_intensity: bool  # the polynomial is of the intensity; else of the phase
    gamma: float
    coefficients: F64  # (degree + 1,) ascending from 0 to 1
    dark: float  # luminance at phase 0
    span: float  # luminance at phase 1 less that
    residual: float  # RMS of the luminances, as a share of `span`

    def phase(self, grey: ArrayLike) -> F64:
        """Phase in [0, 1] of grey in [0, 1]."""
        value = self._polynomial(grey)
        return phase_from_intensity(value, branch=1) if self.of_intensity else value

    def intensity(self, grey: ArrayLike) -> F64:
        """Intensity in [0, 1] of grey in [0, 1]."""
        value = self._polynomial(grey)
        return value if self.of_intensity else intensity_from_phase(value)

    def _polynomial(self, grey: ArrayLike) -> F64:
        polynomial = BPoly(self.coefficients[:, None], [0.0, 1.0])
        return np.asarray(polynomial(np.clip(np.asarray(grey, dtype=np.float64), 0, 1) ** self.gamma))

    def grey(self, phase: ArrayLike) -> F64:
        """Grey in [0, 1] for a phase in [0, 1]: the inverse, by monotone interpolation of a dense table."""
        # Even steps of g^gamma would leave one end coarse, even steps of g the other.
        steps = np.linspace(0, 1, 2001)
        greys = np.unique(np.concatenate([steps, steps ** (1 / self.gamma), steps**3, 1 - steps**3]))
        phases = self.phase(greys)
        rising = np.concatenate([[True], np.diff(np.maximum.accumulate(phases)) > 1e-12])
        inverse = PchipInterpolator(phases[rising], greys[rising])
        found: F64 = np.clip(inverse(np.clip(phase, 0.0, phases[-1])), 0.0, 1.0)
        return found


def _coefficients(free: F64) -> F64:
    """Ascending from 0 to 1 from unbounded numbers: shares of a whole."""
    shares = np.exp(np.concatenate([[0.0], free]) - np.max(free, initial=0.0))
    return np.concatenate([[0.0], np.cumsum(shares) / shares.sum()])


def fit_grey_curve(grey: F64, luminance: F64) -> GreyCurve:
    """The curve from (n,) greys from 0 to 1 and (n,) luminances, at least four greys, white brighter than black.

    Kind and degree of the polynomial are those of the lowest corrected AIC.
    """
    low, high = float(luminance[np.argmin(grey)]), float(luminance[np.argmax(grey)])
    values = (luminance - low) / (high - low)
    best: tuple[float, GreyCurve] | None = None
    for of_intensity in (False, True):
        for degree in range(1, MAX_DEGREE + 1):
            parameters = 3 + degree - 1
            if degree > 1 and parameters + 2 > len(grey):
                break
            curve, cost = _fit(grey, values, degree, of_intensity=of_intensity)
            score = _information(cost, count=len(grey), parameters=parameters)
            if best is None or score < best[0] - 1e-9:
                best = (score, curve)
            if cost < EXACT * len(grey):
                break
    assert best is not None
    return replace(best[1], dark=low + best[1].dark * (high - low), span=best[1].span * (high - low))


def _information(cost: float, *, count: int, parameters: int) -> float:
    """Akaike's criterion, corrected for few samples; perfect fits differ by their parameters alone."""
    variance = max(cost / count, EXACT)
    return count * math.log(variance) + 2 * parameters * count / max(count - parameters - 1, 1)


def _fit(grey: F64, values: F64, degree: int, *, of_intensity: bool) -> tuple[GreyCurve, float]:
    def curve_of(p: F64) -> GreyCurve:
        coefficients = _coefficients(p[3:])
        return GreyCurve(of_intensity, float(np.exp(p[0])), coefficients, float(p[1]), float(np.exp(p[2])), 0.0)

    def residuals(p: F64) -> F64:
        curve = curve_of(p)
        return curve.dark + curve.span * curve.intensity(grey) - values

    start = np.concatenate([[0.0, 0.0, 0.0], np.zeros(degree - 1)])
    fits = [
        least_squares(
            residuals, np.concatenate([[math.log(gamma)], start[1:]]), method="lm", ftol=1e-10, xtol=1e-10, max_nfev=600
        )
        for gamma in (1.0, 2.2)
    ]
    fit = min(fits, key=lambda found: found.cost)
    curve = curve_of(fit.x)
    rms = float(np.sqrt((fit.fun**2).mean())) / curve.span
    return replace(curve, residual=rms), float(2 * fit.cost)


def fit_lut(out: Path, grey: F64, luminance: F64) -> tuple[dict[str, Any], str]:
    """Write a panel's LUT, 256 rows of phase and grey from 0 to 1; returns the summary and its text.

    grey, luminance: (n,). Raises InputError.
    """
    curve = fit_grey_curve(grey, luminance)
    phase = np.linspace(0.0, 1.0, LUT_ROWS)
    greys = np.maximum.accumulate(curve.grey(phase))
    rows = [f"{at:.6f},{value:.6f}\n" for at, value in zip(phase, greys, strict=True)]
    write_text(out, "phase,grey\n" + "".join(rows))
    text = (
        f"smooth in {'intensity' if curve.of_intensity else 'phase'}, gamma {curve.gamma:.3f}, contrast "
        f"{1 + curve.span / max(curve.dark, 1e-9 * curve.span):.4g}, residual {100 * curve.residual:.2f}% of the range"
    )
    return {"file": str(out), **asdict(curve)}, f"{text}\n{out}"
