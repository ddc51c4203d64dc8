"""Hypothesis strategies: eyes, stacks and images within and beyond the design range."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import strategies as st

from runtime.optics.stack import PanelStack


def floats(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_nan=False, allow_infinity=False, allow_subnormal=False)


@st.composite
def eyes(draw: st.DrawFn, *, nearest_m: float = 0.1, farthest_m: float = 4.0, off_axis_deg: float = 70.0) -> np.ndarray:
    """An eye before the stack: distance, angle off the +x axis and direction of that angle."""
    distance = draw(floats(nearest_m, farthest_m))
    tilt = math.radians(draw(floats(0.0, off_axis_deg)))
    turn = draw(floats(-math.pi, math.pi))
    return distance * np.array([math.cos(tilt), math.sin(tilt) * math.cos(turn), math.sin(tilt) * math.sin(turn)])


@st.composite
def stacks(draw: st.DrawFn, *, panels: tuple[int, int] = (2, 4), pixels: tuple[int, int] = (16, 64)) -> PanelStack:
    """Stack whose front panel is at most at x = 3 cm, so that eyes from 0.1 m and 70 degrees are in front of it."""
    gaps = draw(st.lists(floats(0.005, 0.05), min_size=panels[0] - 1, max_size=panels[1] - 1))
    front = draw(floats(0.0, 0.03))
    x_m = [front]
    for gap in gaps:
        x_m.insert(0, x_m[0] - gap)
    return PanelStack(
        draw(floats(0.05, 2.0)),
        draw(floats(0.05, 2.0)),
        tuple(x_m),
        draw(st.integers(*pixels)),
        draw(st.integers(*pixels)),
    )
