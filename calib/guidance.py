"""Where to move to reach a viewpoint: words for a person, from the pairs that are already taken."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib.similarity import Degenerate, Similarity, extents, fit
from runtime.records import F64

LEAST_PAIRS = 3
LEAST_WIDTH_M = 0.02  # of the pairs across their longest direction: nearly a line tells no turn about it
NEAR_M = 0.015  # nearer than this the lines themselves tell better


def rough_similarity(sensor_m: F64, stack_m: F64) -> Similarity | None:
    """`stack_from_sensor` of the pairs so far, metres on both sides; None where they do not tell it yet."""
    if len(sensor_m) < LEAST_PAIRS or extents(stack_m)[1] < LEAST_WIDTH_M:
        return None
    try:
        return fit(sensor_m, stack_m, rule=1.0)
    except Degenerate:
        return None


def way_to(viewpoint_m: F64, eyes_m: F64) -> str:
    """The way from where the eyes (3,) are to a viewpoint (3,), frame `stack`, as "7 cm to the right, 3 cm nearer".

    Empty where they are there.
    """
    step_m = np.asarray(viewpoint_m) - eyes_m
    if np.linalg.norm(step_m) < NEAR_M:
        return ""
    words: Sequence[tuple[float, str, str]] = (
        (float(step_m[1]), "to the right", "to the left"),
        (float(step_m[2]), "up", "down"),
        (float(step_m[0]), "farther away", "nearer"),
    )
    parts = [
        f"{abs(round(100 * distance))} cm {positive if distance > 0 else negative}"
        for distance, positive, negative in words
        if abs(round(100 * distance)) >= 1
    ]
    return ", ".join(parts)
