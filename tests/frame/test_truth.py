"""The recorded truth is told for any instant, once the recording has told what came after it."""

from __future__ import annotations

import numpy as np
import pytest

from runtime.clock import NS_PER_MS
from runtime.frame.observer import GAP_NS, TrueEyes


def eyes(y_m: float) -> np.ndarray:
    return np.array([[0.6, y_m - 0.031, 0.0], [0.6, y_m + 0.031, 0.0]])


@pytest.fixture
def truth() -> TrueEyes:
    """A head that moves aside by a millimetre a sample, every 10 ms."""
    made = TrueEyes()
    for k in range(11):
        made.add(k * 10 * NS_PER_MS, eyes(k / 1000))
    return made


def test_at_a_sample_it_is_the_sample_s_and_between_two_it_lies_between(truth: TrueEyes) -> None:
    assert np.array_equal(truth.at(50 * NS_PER_MS), eyes(0.005))
    assert truth.at(53 * NS_PER_MS) == pytest.approx(eyes(0.0053))
    assert np.array_equal(truth.at(100 * NS_PER_MS), eyes(0.010))  # the newest


def test_after_the_newest_sample_it_is_not_known_yet_and_once_that_has_come_it_is(truth: TrueEyes) -> None:
    asked_ns = 105 * NS_PER_MS
    assert truth.may_come(asked_ns) and truth.at(asked_ns) is None
    truth.add(110 * NS_PER_MS, eyes(0.011))
    assert truth.at(asked_ns) == pytest.approx(eyes(0.0105))


def test_before_the_first_sample_and_after_the_recording_s_end_it_will_never_be_known(truth: TrueEyes) -> None:
    truth.end()
    for never_ns in (105 * NS_PER_MS, -1):
        assert truth.at(never_ns) is None and not truth.may_come(never_ns)
    assert np.array_equal(truth.at(100 * NS_PER_MS), eyes(0.010))


def test_nothing_is_made_up_for_a_gap(truth: TrueEyes) -> None:
    newest_ns = 100 * NS_PER_MS
    truth.add(newest_ns + GAP_NS + 1, eyes(0.5))
    assert truth.at(newest_ns + GAP_NS // 2) is None
    assert np.array_equal(truth.at(newest_ns + GAP_NS + 1), eyes(0.5))
