"""How far eyes have moved, as the panels show it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.plan.reuse import lateral_shift_m

EYES = np.array([[0.6, -0.03, 0.05], [0.6, 0.03, 0.05]])
STEP = st.tuples(*[st.floats(-0.1, 0.1)] * 3).map(np.array)


def test_eyes_that_did_not_move_did_not_move() -> None:
    assert lateral_shift_m(EYES, EYES.copy()) == 0.0


def test_a_step_aside_or_up_is_as_long_as_it_is() -> None:
    ahead = np.array([[0.6, 0.0, 0.0], [0.6, 0.0, 0.0]])
    assert lateral_shift_m(ahead, ahead + np.array([0.0, 0.003, 0.004])) == pytest.approx(0.005)


def test_a_step_towards_the_display_counts_as_far_as_it_changes_what_is_seen() -> None:
    ahead = np.array([[0.6, 0.0, 0.0], [0.6, 0.0, 0.0]])
    assert lateral_shift_m(ahead, ahead + np.array([0.05, 0.0, 0.0])) == 0.0
    assert lateral_shift_m(EYES, EYES + np.array([0.05, 0.0, 0.0])) > 0.003


def test_the_eye_that_moved_farther_counts() -> None:
    one = EYES.copy()
    one[1, 1] += 0.007
    assert lateral_shift_m(EYES, one) == pytest.approx(0.007)


@given(STEP)
def test_it_is_never_negative_and_grows_with_the_step(step: np.ndarray) -> None:
    half, whole = lateral_shift_m(EYES, EYES + 0.5 * step * [0, 1, 1]), lateral_shift_m(EYES, EYES + step * [0, 1, 1])
    assert 0.0 <= half <= whole + 1e-12
    assert lateral_shift_m(EYES, EYES + step) >= 0.0
