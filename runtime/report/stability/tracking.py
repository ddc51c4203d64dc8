"""The tracker's filter against a Kalman filter of 50 digits, and the tracker at extreme time steps and gains."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from runtime.clock import NS_PER_S
from runtime.eyes import imm
from runtime.eyes.tracker import Tracker
from runtime.records import F64, EyePoints
from runtime.report.stability import exact
from runtime.report.stability.trial import EPS64, Answer, Trial

STAGE = "tracker"
EYES_M = np.array([[0.6, -0.031, 0.05], [0.6, 0.032, 0.05]])
FRAME_NS = NS_PER_S // 30
TRAVEL_M = np.array([0.02, 0.09, -0.04])  # of the head over a case, where that is long enough
FASTEST = 0.3  # m/s
FLOOR_M = 1e-6


def kalman(places: F64, dt_s: float, *, haste: float, noise_m: float) -> tuple[Any, Any]:
    """Position and velocity after all places (K, 3), by the tracker's own filter with one model."""
    noise = noise_m**2 * np.eye(3)
    belief = imm.started(places[0], noise=noise, speed=1.0, acceleration=(haste,))
    for place in places[1:]:
        belief = imm.predicted(belief, dt_s, acceleration=(haste,), stay_s=1.0)
        belief = imm.corrected(belief, place, noise=noise)
    return belief.state[0, :3], belief.state[0, 3:6]


@dataclass(frozen=True, slots=True)
class Head:
    """A head that moves evenly: where its eyes are is known at every instant."""

    span_ns: int  # in which it travels TRAVEL_M, or as far as FASTEST takes it

    def eyes_m(self, time_ns: int) -> F64:
        """(2, 3) left, right; frame `stack`."""
        length = float(np.linalg.norm(TRAVEL_M))
        share = min(1.0, FASTEST * self.span_ns / NS_PER_S / length)
        return EYES_M + TRAVEL_M * share * (time_ns / max(self.span_ns, 1))


def exact_kalman(places: F64, dt_s: float, *, haste: float, variance: float) -> tuple[Any, Any]:
    """Position and velocity of one axis after all measurements: Singer's closed forms, 50 digits."""
    mpf, mp = exact.mpf, exact.mp
    x, r, b = mpf(dt_s) / mpf(imm.FADE_S), mpf(variance), mpf(imm.FADE_S)
    gone, gone2 = 1 - mp.exp(-x), 1 - mp.exp(-2 * x)
    step = mp.matrix([[1, b * x, b**2 * (x - gone)], [0, 1, b * gone], [0, 0, 1 - gone]])
    added = mp.matrix(3, 3)
    added[0, 0] = b**4 * (gone2 + 2 * x + 2 * x**3 / 3 - 2 * x**2 - 4 * x * (1 - gone))
    added[0, 1] = added[1, 0] = b**3 * (1 - gone2 + 1 - 2 * (1 - gone) + 2 * x * (1 - gone) - 2 * x + x**2)
    added[0, 2] = added[2, 0] = b**2 * (gone2 - 2 * x * (1 - gone))
    added[1, 1] = b**2 * (4 * (1 - gone) - 3 - (1 - gone2) + 2 * x)
    added[1, 2] = added[2, 1] = b * (1 - gone2 + 1 - 2 * (1 - gone))
    added[2, 2] = gone2
    added *= mpf(haste) ** 2
    state, covariance = mp.matrix([mpf(float(places[0])), 0, 0]), mp.diag([r, 1, mpf(haste) ** 2])
    for place in places[1:]:
        state, covariance = step * state, step * covariance * step.T + added
        gain = covariance[:, 0] / (covariance[0, 0] + r)
        state += gain * (mpf(float(place)) - state[0])
        covariance -= gain * covariance[0, :]
    return state[0], state[1]


def filtered(dt_s: float, *, haste: float, noise_m: float, steps: int = 200) -> Answer:
    """A plain Kalman filter (one model) over a noisy walk; its stiffness is the ratio of its two gains."""
    rng = np.random.default_rng(3)
    places = np.cumsum(rng.normal(0, 0.3 * min(dt_s, 1.0), (steps, 3)), axis=0) + rng.normal(0, noise_m, (steps, 3))
    found, speed = kalman(places, dt_s, haste=haste, noise_m=noise_m)
    error = 0.0
    for axis in range(3):
        truth, truth_speed = exact_kalman(places[:, axis], dt_s, haste=haste, variance=noise_m**2)
        error = max(error, exact.distance(found[axis], truth), dt_s * exact.distance(speed[axis], truth_speed))
    index = haste * dt_s**2 / noise_m  # Kalata's tracking index: how much the filter believes a sample
    stiff = max(index, 1 / index)
    span = float(np.abs(places).max())
    return Answer(error / span, 64 * EPS64 * max(stiff, steps), stiff)


def still(updates: int) -> Answer:
    """A head that does not move must not drift, wherever it came to rest."""
    tracker = Tracker()
    confidence = np.ones(2)
    came = Head(30 * FRAME_NS)
    for index in range(updates):
        eyes = came.eyes_m(min(index, 30) * FRAME_NS)
        tracker.update(EyePoints(eyes, confidence), capture_ns=index * FRAME_NS)
    found = tracker.at((updates - 1) * FRAME_NS).eyes_m
    assert found is not None
    return Answer(float(np.abs(found - came.eyes_m(30 * FRAME_NS)).max()), 1e-9, float(updates))


def after(steps_ns: list[int], ask_ns: int, *, lost: bool = False) -> Answer:
    """A head that moves evenly, sampled at odd intervals and asked for at an odd time: where it is then.

    lost: it was not seen for so long that nobody can know; then an answer is the mistake.
    """
    tracker = Tracker()
    now, head = 0, Head(sum(map(abs, steps_ns)) + ask_ns)
    tracker.update(EyePoints(head.eyes_m(now), np.ones(2)), capture_ns=now)
    for step in steps_ns:
        now += step
        tracker.update(EyePoints(head.eyes_m(now), np.ones(2)), capture_ns=now)
    estimate = tracker.at(now + ask_ns)
    if lost or estimate.eyes_m is None:
        right = lost and estimate.eyes_m is None
        return Answer(0.0 if right else math.inf, 1e-3, note=f"label {estimate.label}")
    error = float(np.abs(estimate.eyes_m - head.eyes_m(now + ask_ns)).max())
    return Answer(error, 1.0, note=f"label {estimate.label}")


def trials(*, full: bool = False) -> Iterator[Trial]:
    """Every case of the tracker; `full` adds the long one."""
    for updates in (10_000, *((1_000_000,) if full else ())):
        yield Trial(STAGE, f"{updates} updates of a still head", partial(still, updates), measure="m")
    for name, dt_s, haste, noise_m in (
        ("as it is used", 1 / 30, 1.0, 0.003),
        ("1 kHz", 1e-3, 1.0, 0.003),
        ("a sample a second", 1.0, 1.0, 0.003),
        ("believes every sample", 1 / 30, 1e4, 1e-3),
        ("believes hardly any", 1 / 30, 1e-6, 0.03),
        ("microseconds apart", 1e-6, 1.0, 0.003),
    ):
        run = partial(filtered, dt_s, haste=haste, noise_m=noise_m)
        yield Trial(STAGE, f"Kalman filter, {name}", run, measure="of the walk")
    hour, usual = 3600 * NS_PER_S, [FRAME_NS] * 30
    for name, steps, ask in (
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
        run = partial(after, steps, ask, lost=ask == hour)
        yield Trial(STAGE, name, run, measure="m", floor=None if ask == hour else FLOOR_M)
