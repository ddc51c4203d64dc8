"""Cases that test the tracker with extreme time steps and a head whose positions are known exactly."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial

import numpy as np

from runtime.clock import NS_PER_S
from runtime.eyes.tracker import Tracker
from runtime.records import F64, EyePoints
from runtime.report.stability.trial import Answer, Trial

STAGE = "tracker"
EYES_M = np.array([[0.6, -0.031, 0.05], [0.6, 0.032, 0.05]])
FRAME_NS = NS_PER_S // 30
TRAVEL_M = np.array([0.02, 0.09, -0.04])  # the head's movement during a case, reduced to stay below FASTEST
FASTEST = 0.3  # the head's maximum speed, m/s
FLOOR_M = 1e-6  # difference that may be due to another machine's rounding


def head_m(time_ns: int, *, span_ns: int) -> F64:
    """Return the (2, 3) eyes of a head that moves by TRAVEL_M in `span_ns`, or at most at FASTEST."""
    share = min(1.0, FASTEST * span_ns / NS_PER_S / float(np.linalg.norm(TRAVEL_M)))
    return EYES_M + TRAVEL_M * share * (time_ns / max(span_ns, 1))


def still(updates: int) -> Answer:
    """Measure the tracked eyes' error after a number of updates, most of them from a head at rest."""
    tracker, span_ns = Tracker(), 30 * FRAME_NS
    for index in range(updates):
        eyes = head_m(min(index * FRAME_NS, span_ns), span_ns=span_ns)
        tracker.update(EyePoints(eyes, np.ones(2)), capture_ns=index * FRAME_NS)
    eyes_m = tracker.at((updates - 1) * FRAME_NS).eyes_m
    assert eyes_m is not None
    return Answer(float(np.abs(eyes_m - head_m(span_ns, span_ns=span_ns)).max()), 1e-9, float(updates))


def after(steps_ns: list[int], ahead_ns: int, *, lost: bool = False) -> Answer:
    """Measure the error of eyes predicted `ahead_ns` after samples at irregular intervals. If `lost`, the
    last sample is too old, and the tracker must return no position.
    """
    tracker, now_ns, span_ns = Tracker(), 0, sum(map(abs, steps_ns)) + ahead_ns
    for step_ns in (0, *steps_ns):
        now_ns += step_ns
        tracker.update(EyePoints(head_m(now_ns, span_ns=span_ns), np.ones(2)), capture_ns=now_ns)
    estimate = tracker.at(now_ns + ahead_ns)
    if lost or estimate.eyes_m is None:
        correct = lost and estimate.eyes_m is None
        return Answer(0.0 if correct else math.inf, 1e-3, note=f"label {estimate.label}")
    error = float(np.abs(estimate.eyes_m - head_m(now_ns + ahead_ns, span_ns=span_ns)).max())
    return Answer(error, 1.0, note=f"label {estimate.label}")


def trials(*, full: bool = False) -> Iterator[Trial]:
    """Yield all trials for the tracker, with a million updates if `full`."""
    for updates in (10_000, *((1_000_000,) if full else ())):
        yield Trial(STAGE, f"{updates} updates of a still head", partial(still, updates), measure="m")
    hour, usual = 3600 * NS_PER_S, [FRAME_NS] * 30
    for name, steps, ahead in (
        ("the same instant twice", [*usual, 0], 0),
        ("1 ns apart", [*usual, 1], 0),
        ("1 ns apart, all of them", [1] * 100, 0),
        ("one hour apart", [*usual, hour], 0),
        ("a day from the clock's zero", [24 * hour, *usual], FRAME_NS),
        ("300 years from the clock's zero", [9_200_000_000 * NS_PER_S, *usual], FRAME_NS),
        ("time set back", [*usual, -2 * NS_PER_S, *usual], 0),
        ("asked 60 ms ahead", usual, 60_000_000),
        ("asked an hour ahead", usual, hour),
    ):
        run = partial(after, steps, ahead, lost=ahead == hour)
        yield Trial(STAGE, name, run, measure="m", floor=None if ahead == hour else FLOOR_M)
