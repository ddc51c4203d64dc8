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
FARTHEST_M = 100.0  # no sensor sees a face from there; larger numbers overflow when squared
KEEP_S = 0.4  # after a longer gap nothing of a head's motion is left
CLOCK_RESET_NS = NS_PER_S  # a capture this far in the past is a clock that was set back, not a late sample
FIRST_SPEED = 0.3  # m/s, of a head that was just found
COMPLETED_NOISE = 2.0  # an eye that was filled in is this much less certain
NO_JUMP = np.zeros((2, 3))


class _Sample(NamedTuple):
    """A filtered sample."""

    capture_ns: int
    middle: tuple[imm.Model, ...]  # between the eyes, frame `stack`
    half: tuple[imm.Model, ...]  # from the middle to the right eye
    jump_m: F64  # (2, 3) from here back to what was shown last, at `jump_ns`; fades from then on
    jump_ns: int


class Tracker:
    """One viewer's eyes. `update` takes samples as they come; `at` answers for any instant.

    Eyes that return after a loss take over from where `at` last said that they were, and fade to where they are.
    """

    def __init__(self, settings: TrackerSettings | None = None) -> None:
        self.settings = settings or TrackerSettings()
        self._variance = self.settings.noise_m**2 / 2  # of the middle, and of half the line between the eyes
        self._history: deque[_Sample] = deque(maxlen=HISTORY)
        self._refused: tuple[int, imm.Vector] | None = None
        self._lost_ns: int | None = None
        self._newest_ns = -1
        self._asked_ns = 0  # the latest instant that `at` answered for: what was shown last
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
        if not min(points.confidence.tolist()) >= self.settings.confidence_min:
            return
        (lx, ly, lz), (rx, ry, rz) = points.eyes_m.tolist()
        half = (rx - lx) / 2, (ry - ly) / 2, (rz - lz) / 2
        middle = lx + half[0], ly + half[1], lz + half[2]
        ipd_m = 2 * math.hypot(*half)
        is_person = self.settings.ipd_min_m <= ipd_m <= self.settings.ipd_max_m
        if not (is_person and math.hypot(*middle) <= FARTHEST_M):  # NaN is refused as well
            self.outliers += 1
            return
        self._take(middle, half, capture_ns=capture_ns, completed=bool(points.completed))

    def forget(self) -> None:
        """As if nothing had ever been seen."""
        self._history.clear()
        self._refused = self._lost_ns = None
        self._newest_ns, self._asked_ns = -1, 0

    def _take(self, middle: imm.Vector, half: imm.Vector, *, capture_ns: int, completed: bool) -> None:
        s = self.settings
        variance = self._variance * (COMPLETED_NOISE**2 if completed else 1.0)
        last = self._history[-1] if self._history else None
        age_s = (capture_ns - last.capture_ns) / NS_PER_S if last else math.inf
        jump_m, jump_ns = (last.jump_m, last.jump_ns) if last else (NO_JUMP, 0)
        is_held = self._lost_ns is not None or age_s > s.loss_s
        found = side = None
        if last is not None and age_s <= KEEP_S:
            now = imm.predicted(last.middle, age_s, acceleration=s.acceleration, stay_s=s.stay_s)
            turned = imm.predicted(last.half, age_s, acceleration=(s.turn_acceleration,), stay_s=s.stay_s)
            if (
                imm.surprise(now, middle, variance=variance) <= CHI2_GATE
                and imm.surprise(turned, half, variance=variance) <= CHI2_GATE
            ):
                found = imm.corrected(now, middle, variance=variance)
                side = imm.corrected(turned, half, variance=variance)
            elif not is_held and not self._is_confirmed(middle, capture_ns):
                self._refused = capture_ns, middle
                self.outliers += 1
                return
        is_new = found is None or side is None
        if found is None or side is None:
            found = imm.started(middle, count=len(s.acceleration), variance=variance, speed=FIRST_SPEED)
            side = imm.started(half, count=1, variance=variance, speed=FIRST_SPEED / 3)
        if is_held or is_new:
            jump_ns = max(self._asked_ns, capture_ns)
            before = self.at(jump_ns).eyes_m
            ahead_s = min((jump_ns - capture_ns) / NS_PER_S, s.horizon_max_s)
            jump_m = NO_JUMP if before is None else before - _eyes(found, side, ahead_s)
        self._history.append(_Sample(capture_ns, found, side, jump_m, jump_ns))
        self._refused = self._lost_ns = None

    def _is_confirmed(self, middle: imm.Vector, capture_ns: int) -> bool:
        """True where the sample before was refused for being in the same other place."""
        if self._refused is None:
            return False
        then_ns, then = self._refused
        reach_m = 4 * self.settings.noise_m + self.settings.speed_max * (capture_ns - then_ns) / NS_PER_S
        return math.dist(middle, then) <= reach_m

    def ahead(self, time_ns: int) -> EyesEstimate:
        """As `at`, for an instant that is not (yet) shown: what `at` answers later does not depend on it."""
        asked_ns = self._asked_ns
        estimate = self.at(time_ns)
        self._asked_ns = asked_ns
        return estimate

    def at(self, time_ns: int) -> EyesEstimate:
        """Where the eyes are at an instant of the samples' clock that is shown.

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
        self._asked_ns = max(self._asked_ns, time_ns)
        label: EyesLabel = "predicted"
        ahead_s = min(age_s, self.settings.horizon_max_s)
        if self._lost_ns is not None:
            known_s = min((self._lost_ns - newest.capture_ns) / NS_PER_S, ahead_s)
            rest_s = self.settings.decay_s
            label, ahead_s = "held", known_s + rest_s * -math.expm1(-(ahead_s - known_s) / rest_s)
        elif age_s > self.settings.loss_s:
            label = "held"
        eyes = self._eyes(newest, ahead_s, time_ns)
        return EyesEstimate(time_ns, newest.capture_ns, eyes, label, age_ns, self._sigma_m(newest, ahead_s))

    def _sigma_m(self, sample: _Sample, ahead_s: float) -> float:
        return imm.deviation(sample.middle, ahead_s, acceleration=self.settings.acceleration)

    def _past(self, time_ns: int, age_ns: int) -> EyesEstimate:
        index = bisect_left(self._history, time_ns, key=lambda sample: sample.capture_ns)
        after = self._history[index]
        if after.capture_ns == time_ns:
            eyes = self._eyes(after, 0.0, time_ns)
            return EyesEstimate(time_ns, time_ns, eyes, "exact", 0, self._sigma_m(after, 0.0))
        before = self._history[index - 1]
        weight = (time_ns - before.capture_ns) / (after.capture_ns - before.capture_ns)
        eyes = (1 - weight) * self._eyes(before, 0.0, time_ns) + weight * self._eyes(after, 0.0, time_ns)
        sigma_m = self._sigma_m(after, 0.0)
        return EyesEstimate(time_ns, after.capture_ns, eyes, "interpolated", time_ns - after.capture_ns, sigma_m)

    def _eyes(self, sample: _Sample, ahead_s: float, time_ns: int) -> F64:
        eyes = _eyes(sample.middle, sample.half, ahead_s)
        if sample.jump_m is not NO_JUMP:
            fraction = min(max((time_ns - sample.jump_ns) / NS_PER_S / self.settings.revive_s, 0.0), 1.0)
            eyes += sample.jump_m * (1 - fraction * fraction * (3 - 2 * fraction))
        return eyes


def _eyes(middle: tuple[imm.Model, ...], half: tuple[imm.Model, ...], ahead_s: float) -> F64:
    """(2, 3) left and right eye, so many seconds after the filters' instant."""
    place, velocity = np.array([*zip(imm.combined(middle), imm.combined(half), strict=True)])
    centre, side = place + velocity * ahead_s
    return np.array([centre - side, centre + side])
