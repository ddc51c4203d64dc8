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


def quantised(bits: int, panels: int) -> Answer:
    """Panel values rounded to a panel's grey levels: what is told of them, before and after, against 50 digits.

    The answer is what rounding costs at most; where the code tells another cost than 50 digits do, it is that far off.
    """
    values = np.random.default_rng(8).random((128, panels))
    levels = 2**bits - 1
    rounded = np.rint(values * levels) / levels
    meant, shown = (intensity_from_phase(part.sum(axis=1)) for part in (values, rounded))
    worst, wrong = 0.0, 0.0
    for number, (row, grey) in enumerate(zip(values, rounded, strict=True)):
        truth = exact.jones_intensity(row), exact.jones_intensity(grey)
        worst = max(worst, float(abs(truth[0] - truth[1])))
        wrong = max(wrong, exact.distance(meant[number], truth[0]), exact.distance(shown[number], truth[1]))
    bound = panels * math.pi / 4 / levels
    if wrong > 16 * EPS64 * panels:
        return Answer(1.0, bound, panels * math.pi / 2, note=f"told intensities are off by {wrong:.2g}")
    return Answer(worst, bound, panels * math.pi / 2, 0.5 / levels)


def across_a_branch(total: float) -> Answer:
    """Just below and just above a phase sum at which the branch changes the intensity must not jump."""
    below, above = (float(intensity_from_phase(np.array(total + side * 1e-9))) for side in (-1, 1))
    truth = [exact.mp.sin((exact.mpf(total) + exact.mpf(side * 1e-9)) * exact.mp.pi / 2) ** 2 for side in (-1, 1)]
    error = max(exact.distance(below, truth[0]), exact.distance(above, truth[1]))
    return Answer(error, 4 * EPS64 * max(total, 1.0), max(total, 1.0))


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
    for bits in (8, 10, 16):
        for panels in (2, 3, 4):
            run = partial(quantised, bits, panels)
            yield Trial(PHASE, f"{panels} panels of {bits} bits", run, measure="intensity")
    for total in (0.0, 1.0, 2.0, 3.0):
        yield Trial(PHASE, f"sum across {total:g}", partial(across_a_branch, total), measure="intensity")
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
