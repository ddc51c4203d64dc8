"""Malus' law where the arcsine's slope is infinite, and Jones products (EyeReal supplement, (1)-(7))."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Literal

import numpy as np

from runtime.optics.malus import intensity_from_phase, jones_intensity, phase_from_intensity
from runtime.report.stability import exact
from runtime.report.stability.trial import EPS32, EPS64, Answer, Trial

PHASE, JONES = "phase", "Jones optics"
INTENSITIES = {
    "0": 0.0, "the least subnormal": 5e-324, "1e-300": 1e-300, "1e-16": 1e-16, "1e-8": 1e-8, "1/255": 1 / 255,
    "1/2": 0.5, "254/255": 254 / 255, "1 - 1e-8": 1 - 1e-8, "1 - 1e-12": 1 - 1e-12,
    "1 - eps/2": 1 - EPS64 / 2, "1": 1.0,
}  # fmt: skip


def of_intensity(intensity: float, branch: Literal[1, 2]) -> Answer:
    """The phase of an intensity. Towards 1 the slope of the arcsine, and the condition with it, goes to infinity."""
    truth = exact.phase(intensity, branch)
    found = phase_from_intensity(np.array(intensity), branch)
    # Relative condition of asin(sqrt(I)); a double spaced eps from 1 bounds it there.
    away = max(1 - intensity, EPS64)
    condition = max(1.0, math.sqrt(intensity / away) / math.pi / float(max(truth, exact.mpf("1e-30"))))
    error = exact.distance(found, truth)
    back = abs(float(intensity_from_phase(found)) - intensity)
    return Answer(error, 4 * EPS64 * condition, condition, back)


def single(branch: Literal[1, 2]) -> Answer:
    """float32, as the network's inputs are: every 8-bit intensity there and back."""
    codes = (np.arange(256) / np.float32(255)).astype(np.float32)
    phase = phase_from_intensity(codes, branch)
    truth = [exact.phase(float(code), branch) for code in codes]
    error = max(exact.distance(found, exactly) for found, exactly in zip(phase, truth, strict=True))
    back = float(np.abs(intensity_from_phase(phase) - codes).max())
    return Answer(error, EPS32 * 64, 16.0, back, note="the last code before white is the hardest")


def product(values: Sequence[float]) -> Answer:
    """sin² of the summed phase, and the product of the panels' Jones matrices, both against 50 digits."""
    truth = exact.jones_intensity(values)
    by_sum = float(intensity_from_phase(np.array(math.fsum(values))))
    by_product = jones_intensity([value * math.pi / 2 for value in values])
    error = max(exact.distance(by_sum, truth), exact.distance(by_product, truth))
    return Answer(error, 1e-12, max(1.0, math.fsum(values) * math.pi / 2))


def trials() -> Iterator[Trial]:
    """Every case of the phase and of the panels' product."""
    branches: tuple[Literal[1, 2], ...] = (1, 2)
    for branch in branches:
        for name, intensity in INTENSITIES.items():
            yield Trial(
                PHASE,
                f"branch {branch}, intensity {name}",
                partial(of_intensity, intensity, branch),
                measure="phase",
            )
        yield Trial(PHASE, f"branch {branch}, float32, all 8-bit codes", partial(single, branch), measure="phase")
    rng = np.random.default_rng(5)
    for panels in range(1, 9):
        yield Trial(JONES, f"{panels} panels", partial(product, rng.random(panels).tolist()), measure="intensity")
    for name, values in (
        ("8 panels, all dark", [0.0] * 8),
        ("8 panels, all at their limit", [1.0] * 8),
        ("8 panels at 1e-9", [1e-9] * 8),
        ("limits and 1e-12 in turn", [1.0, 1e-12] * 4),
        ("sum just below 2", [0.5, 0.5, 1 - EPS64]),
    ):
        yield Trial(JONES, name, partial(product, values), measure="intensity")
