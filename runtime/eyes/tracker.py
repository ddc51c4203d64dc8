"""Where the eyes are at any instant: gates, filters, keeps a history, predicts, and says how it knows."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque
from typing import NamedTuple

import numpy as np

from runtime.clock import NS_PER_S
from runtime.config import TrackerSettings
from runtime.eyes import imm
from runtime.records import F64, EyePoints, EyesEstimate, EyesLabel

HISTORY = 256  # filtered samples kept: four seconds at 60 Hz
CHI2_GATE = 21.1  # of three axes: one honest sample in 10 000 is refused
CLOCK_RESET_NS = NS_PER_S  # a capture this far in the past is a clock that was set back, not a late sample
FIRST_SPEED = 0.3  # m/s, of a head that was just found
COMPLETED_NOISE = 2.0  # an eye that was filled in is this much less certain
NO_JUMP = np.zeros((2, 3))


class _Sample(NamedTuple):
    """A filtered sample."""

    capture_ns: int
    middle: tuple[imm.Model, ...]  # between the eyes, frame `stack`
    half: tuple[imm.Model, ...]  # from the middle to the right eye
    place: F64  # (4, 3) what follows from both: middle, its velocity, half, its velocity
    jump_m: F64  # (2, 3) what a revival hides, as it stood at `jump_ns`
    jump_ns: int


class Tracker:
    """One viewer's eyes. `update` takes samples as they come; `at` answers for any instant."""

    def __init__(self, settings: TrackerSettings | None = None) -> None:
        self.settings = settings or TrackerSettings()
        self._variance = self.settings.noise_m**2 / 2  # of the middle, and of half the line between the eyes
        self._history: deque[_Sample] = deque(maxlen=HISTORY)
        self._refused: tuple[int, F64] | None = None
        self._lost_ns: int | None = None
        self._newest_ns = -1
        self.outliers = 0

    def update(self, points: EyePoints | None, *, capture_ns: int) -> None:
        """Take in a sample in the `stack` frame; None: the sensor looked and saw no face.

        What is not finite, implausible for a person, uncertain (a blink), old or doubled is refused; eyes
        that are really elsewhere are believed at their second sample in a row.
        """
        if capture_ns <= self._newest_ns:
            if self._newest_ns - capture_ns < CLOCK_RESET_NS:
                return
            self.forget()
        self._newest_ns = capture_ns
        if points is None:
            self._lost_ns = capture_ns if self._lost_ns is None else self._lost_ns
            return
        if not float(points.confidence.min()) >= self.settings.confidence_min:
            return
        half = (points.eyes_m[1] - points.eyes_m[0]) / 2
        middle = points.eyes_m[0] + half
        ipd_m = 2 * math.sqrt(half @ half)
        if not (math.isfinite(middle.sum()) and self.settings.ipd_min_m <= ipd_m <= self.settings.ipd_max_m):
            self.outliers += 1
            return
        self._take(middle, half, capture_ns=capture_ns, completed=bool(points.completed))

    def forget(self) -> None:
        """As if nothing had ever been seen."""
        self._history.clear()
        self._refused = self._lost_ns = None
        self._newest_ns = -1

    def _take(self, middle: F64, half: F64, *, capture_ns: int, completed: bool) -> None:
        variance = self._variance * (COMPLETED_NOISE**2 if completed else 1.0)
        last = self._history[-1] if self._history else None
        age_s = (capture_ns - last.capture_ns) / NS_PER_S if last else math.inf
        if last is not None and age_s <= self.settings.horizon_max_s:
            s, place, turn = self.settings, middle.tolist(), half.tolist()
            now = imm.predicted(last.middle, age_s, acceleration=s.acceleration, stay_s=s.stay_s)
            side = imm.predicted(last.half, age_s, acceleration=(s.turn_acceleration,), stay_s=s.stay_s)
            if (
                imm.surprise(now, place, variance=variance) <= CHI2_GATE
                and imm.surprise(side, turn, variance=variance) <= CHI2_GATE
            ):
                self._keep(
                    capture_ns,
                    imm.corrected(now, place, variance=variance),
                    imm.corrected(side, turn, variance=variance),
                    last.jump_m,
                    last.jump_ns,
                )
                return
            if not self._is_confirmed(middle, capture_ns):
                self._refused = capture_ns, middle
                self.outliers += 1
                return
        before = self.at(capture_ns).eyes_m
        jump = NO_JUMP if before is None else before - np.array([middle - half, middle + half])
        count = len(self.settings.acceleration)
        found = imm.started(middle.tolist(), count=count, variance=variance, speed=FIRST_SPEED)
        side = imm.started(half.tolist(), count=1, variance=variance, speed=FIRST_SPEED / 3)
        self._keep(capture_ns, found, side, jump, capture_ns)

    def _is_confirmed(self, middle: F64, capture_ns: int) -> bool:
        """True where the sample before was refused for being in the same other place."""
        if self._refused is None:
            return False
        then_ns, then = self._refused
        reach_m = 4 * self.settings.noise_m + self.settings.speed_max * (capture_ns - then_ns) / NS_PER_S
        return float(np.linalg.norm(middle - then)) <= reach_m

    def _keep(
        self, capture_ns: int, middle: tuple[imm.Model, ...], half: tuple[imm.Model, ...], jump_m: F64, jump_ns: int
    ) -> None:
        place = np.array([*imm.combined(middle), *imm.combined(half)])
        self._history.append(_Sample(capture_ns, middle, half, place, jump_m, jump_ns))
        self._refused = self._lost_ns = None

    def at(self, time_ns: int) -> EyesEstimate:
        """Where the eyes are at an instant of the samples' clock.

        exact: a sample was taken then; interpolated: between two samples; predicted: after the newest, at
        most `horizon_max_s` ahead; held: the face is lost, the eyes drift to rest; none: never seen, lost
        for longer than `hold_s`, or forgotten.
        """
        if not self._history or time_ns < self._history[0].capture_ns:
            return EyesEstimate(time_ns, 0, None, "none")
        newest = self._history[-1]
        age_ns = time_ns - newest.capture_ns
        if age_ns <= 0:
            return self._past(time_ns, age_ns)
        age_s = age_ns / NS_PER_S
        if age_s > self.settings.hold_s:
            return EyesEstimate(time_ns, newest.capture_ns, None, "none", age_ns)
        label: EyesLabel = "predicted"
        ahead_s = min(age_s, self.settings.horizon_max_s)
        if self._lost_ns is not None:
            known_s = min((self._lost_ns - newest.capture_ns) / NS_PER_S, ahead_s)
            rest_s = self.settings.decay_s
            label, ahead_s = "held", known_s + rest_s * -math.expm1(-(ahead_s - known_s) / rest_s)
        elif age_s > self.settings.loss_s:
            label = "held"
        return EyesEstimate(time_ns, newest.capture_ns, self._eyes(newest, ahead_s, time_ns), label, age_ns)

    def _past(self, time_ns: int, age_ns: int) -> EyesEstimate:
        index = bisect_left(self._history, time_ns, key=lambda sample: sample.capture_ns)
        after = self._history[index]
        if after.capture_ns == time_ns:
            eyes = self._eyes(after, 0.0, time_ns)
            return EyesEstimate(time_ns, time_ns, eyes, "exact", 0)
        before = self._history[index - 1]
        weight = (time_ns - before.capture_ns) / (after.capture_ns - before.capture_ns)
        eyes = (1 - weight) * self._eyes(before, 0.0, time_ns) + weight * self._eyes(after, 0.0, time_ns)
        return EyesEstimate(time_ns, after.capture_ns, eyes, "interpolated", time_ns - after.capture_ns)

    def _eyes(self, sample: _Sample, ahead_s: float, time_ns: int) -> F64:
        middle, half = sample.place[0::2] + sample.place[1::2] * ahead_s
        eyes = np.array([middle - half, middle + half])
        since_s = (time_ns - sample.jump_ns) / NS_PER_S
        if sample.jump_m is not NO_JUMP and 0.0 <= since_s < self.settings.revive_s:
            fraction = since_s / self.settings.revive_s
            eyes += sample.jump_m * (1 - fraction * fraction * (3 - 2 * fraction))
        return eyes
