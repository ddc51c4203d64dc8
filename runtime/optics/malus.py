"""Malus' law for the summed phase of N panels between crossed polarizers (supplement, (1)-(7))."""

from __future__ import annotations

from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

HALF_PI = np.pi / 2
Branch = Literal[1, 2]
T = TypeVar("T", bound=np.floating[Any])
# Panel values at rest, before any solving. Their sum is halfway up one of the slopes of sin².
REST = {2: 0.75, 3: 0.5, 4: 0.375, 5: 0.5}


def rest_value(panels: int) -> float:
    """Return the value in [0, 1] that each of `panels` panels shows at rest."""
    return REST.get(panels, 1.5 / panels)


def rest_code(panels: int) -> int:
    """Return `rest_value` as an 8-bit code."""
    return int(rest_value(panels) * 255 + 0.5)


def intensity_from_phase(phase: NDArray[T]) -> NDArray[T]:
    """Return the intensity sin²(π/2·phase) for summed panel values (equation (7)); keeps the dtype."""
    result: NDArray[T] = np.sin(phase * HALF_PI) ** 2
    return result


def phase_from_intensity(intensity: NDArray[T], branch: Branch = 2) -> NDArray[T]:
    """Return the phase sums (...), in units of π/2, whose sin² is `intensity` clipped to [0, 1].

    Branch 1 gives sums in [0, 1], branch 2 in [1, 2]. With three panels, branch 2 keeps the outer two panels far from
    their limits.
    """
    root = np.arcsin(np.sqrt(np.clip(intensity, 0.0, 1.0))) / HALF_PI
    result: NDArray[T] = root if branch == 1 else 2 - root
    return result
