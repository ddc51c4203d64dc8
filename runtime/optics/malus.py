"""Malus' law for the summed phase of N panels between crossed polarizers (supplement, (1)-(7))."""

from __future__ import annotations

from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

HALF_PI = np.pi / 2
Branch = Literal[1, 2]
T = TypeVar("T", bound=np.floating[Any])
# Panel values before any solving, keyed by the number of panels. They add up to the middle of a slope of sin².
REST = {2: 0.75, 3: 0.5, 4: 0.375, 5: 0.5}


def rest_value(panels: int) -> float:
    """Return the value in [0, 1] that every panel has before any solving, in a stack of `panels` panels."""
    return REST.get(panels, 1.5 / panels)


def rest_code(panels: int) -> int:
    """Return `rest_value` as an 8-bit code."""
    return int(rest_value(panels) * 255 + 0.5)


def intensity_from_phase(phase: NDArray[T]) -> NDArray[T]:
    """Return the intensity sin²(π/2·phase) for a sum of panel values, equation (7). Keeps the dtype."""
    result: NDArray[T] = np.sin(phase * HALF_PI) ** 2
    return result


def phase_from_intensity(intensity: NDArray[T], branch: Branch = 2) -> NDArray[T]:
    """Return the sum of panel values, the phase in units of π/2, that produces an intensity, which is
    clipped to [0, 1]. The sum is in [0, 1] on branch 1 and in [1, 2] on branch 2, which keeps three panels far from
    their limits.
    """
    root = np.arcsin(np.sqrt(np.clip(intensity, 0.0, 1.0))) / HALF_PI
    result: NDArray[T] = root if branch == 1 else 2 - root
    return result
