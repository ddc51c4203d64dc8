"""Track the viewer's eyes: refuse implausible samples, filter the rest and predict eye positions."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from runtime.clock import NS_PER_S
from runtime.config import TrackerSettings
from runtime.eyes import imm
from runtime.eyes.noise import NoiseWatch
from runtime.eyes.plausibility import NOT_NEWER, reason_against
from runtime.records import F64, EyePoints, Eyes, EyesEstimate, EyesLabel

HISTORY = 256  # number of filtered samples kept: four seconds at 60 Hz
CONFIDENCE_MIN = 0.3  # samples with less confidence, such as those taken during a blink, are refused
CHI2_GATE = 21.1  # limit for chi² with three degrees of freedom; refuses one good sample in 10,000
SLACK_M2 = 0.002**2 * np.eye(3)  # added to the gate's noise, because heads also move in ways that no model expects
CHI2_DOUBT = 11.3  # 1 % limit; a sample beyond it is undone if the next two fit better without it
ACCELERATION = (0.05, 0.4, 2.0)  # standard deviations in m/s² for a calm, a moving and a fast head
STAY_S = 1.0  # mean time that a head stays calm, moving or fast
# Standard deviations in m/s² for half the vector between the eyes, for a head that hardly turns and one that shakes.
TURN_ACCELERATION = (0.03, 0.4)
FIRST_SPEED = 0.3  # standard deviation of a newly found head's velocity, in m/s
REACH_SPEED, REACH_ACCELERATION = 2.0, 30.0  # limits of a head's motion in m/s and m/s²
KEEP_S = 0.4  # after a longer gap between samples, a head's motion estimate is discarded
ANOTHER_AFTER_S = 0.5  # a viewer unseen for this long, or for hold_s if that is shorter, is replaced by another person
HORIZON_S = 0.2  # longest prediction; after this time without a sample, eyes are held
COAST_S = 0.4  # a lost head moves on for at most this long after its newest sample
DECAY_S = 0.2  # time constant for slowing a lost head to rest; most heads move on while the sensor misses them
REVIVE_S = 0.06  # length of the blend when lost eyes are found again
IDENTITY_S = 0.25  # a person unseen for longer is not recognised by their movement
HEAD_ACCELERATION = 10.0  # limit in m/s² for deciding who is who; people who sit, walk or lean stay below it
CLOCK_RESET_NS = NS_PER_S  # if a capture time is this far in the past, the clock was set back
COMPLETED_NOISE = 2.0  # factor for the standard deviation of a pair of eyes if one eye's position is inferred
NOISE_FLOOR_M = 2e-5  # smallest standard deviation accepted from a driver; no sensor measures pupils more precisely
ESTABLISHED = 3  # a head with fewer samples than this may be a mistake
SIGMA_AHEAD_S = imm.LONGEST_S  # uncertainty is extrapolated no further than this
NEAREST_M = 0.1  # minimum distance from the display to use when weighing depth errors
PANEL_M = (0.5184, 0.2916)  # default panel width and height
# The filtered quantities: the midpoint of the eyes and the vector from the midpoint to the right eye.
MODELS = imm.Models.of(ACCELERATION, TURN_ACCELERATION, stay_s=STAY_S)
HEAD_FROM_EYES = np.array([[0.5, 0.5], [-0.5, 0.5]])
EYES_FROM_HEAD = np.array([[1.0, -1.0], [1.0, 1.0]])

UNCERTAIN = "uncertain"
ELSEWHERE = "not where the viewer is"


@dataclass(frozen=True)
class _Head:
    """One head's estimated motion at the time of its newest sample."""

    capture_ns: int  # capture time of the newest sample
    belief: imm.Belief  # midpoint of the eyes, frame `stack`, and vector from the midpoint to the right eye
    samples: int  # number of samples behind the estimate
    surprise: float  # chi² of the newest sample

    @cached_property
    def moments(self) -> imm.Moments:
        return imm.moments(self.belief, models=MODELS)

    def age_s(self, time_ns: int) -> float:
        return (time_ns - self.capture_ns) / NS_PER_S

    def eyes_m(self, ahead_s: float) -> F64:
        """Return the (2, 3) left and right eye `ahead_s` seconds after the newest sample."""
        eyes_m: Eyes = EYES_FROM_HEAD @ imm.ahead(self.moments, ahead_s)
        return eyes_m


class _Sample(NamedTuple):
    """A measurement that has passed the plausibility checks."""

    capture_ns: int
    head_m: F64  # (2, 3) midpoint of the eyes, frame `stack`, and vector from the midpoint to the right eye
    noise_m2: F64  # (3, 3) covariance of each row of `head_m`

    def begun(self) -> _Head:
        """Return a new head estimated from this sample alone."""
        belief = imm.started(self.head_m, noise=self.noise_m2, speeds=(FIRST_SPEED, FIRST_SPEED / 3), models=MODELS)
        return _Head(self.capture_ns, belief, 1, 0.0)

    def continued(self, head: _Head) -> _Head | None:
        """Return a head updated with this sample, or None if the sample cannot belong to it."""
        age_s = head.age_s(self.capture_ns)
        if age_s > KEEP_S:
            return None
        expected = imm.predicted(head.belief, age_s, models=MODELS)
        seen = imm.innovation(expected, self.head_m, noise=self.noise_m2, models=MODELS)
        surprise = imm.surprise(seen, models=MODELS)
        if surprise > CHI2_GATE:
            loosely = imm.innovation(expected, self.head_m, noise=self.noise_m2 + SLACK_M2, models=MODELS)
            if imm.surprise(loosely, models=MODELS) > CHI2_GATE:
                return None
        belief = imm.corrected(expected, seen, models=MODELS)
        return _Head(self.capture_ns, belief, head.samples + 1, surprise)

    def is_within_reach_of(self, head: _Head) -> bool:
        """Return True if a head could have moved to this sample's position since its own newest sample."""
        age_s = head.age_s(self.capture_ns)
        reach_m = min(REACH_SPEED * age_s, REACH_ACCELERATION * age_s**2 / 2)
        noise_m = math.sqrt(np.trace(self.noise_m2 + SLACK_M2 + head.belief.covariance[0, :3, :3]))
        off_m = self.head_m - imm.ahead(head.moments, min(age_s, HORIZON_S))
        return bool(np.linalg.norm(off_m[0]) <= reach_m + 4 * noise_m)


@dataclass(frozen=True, slots=True)
class _Shown:
    """The viewer's head after a sample, with a jump that is still being smoothed out."""

    head: _Head
    jump_m: F64 | None  # (2, 3) vectors from the measured to the last shown eyes at `jump_ns`; they decay from then on
    jump_ns: int

    def eyes_m(self, ahead_s: float, time_ns: int) -> F64:
        """Return the (2, 3) eyes, predicted `ahead_s` after the newest sample, and the rest of a jump."""
        eyes = self.head.eyes_m(ahead_s)
        if self.jump_m is not None:
            fraction = min(max((time_ns - self.jump_ns) / NS_PER_S / REVIVE_S, 0.0), 1.0)
            eyes += self.jump_m * (1 - fraction * fraction * (3 - 2 * fraction))
        return eyes


class _Other(NamedTuple):
    """A head that was seen somewhere other than the viewer's position."""

    head: _Head
    may_be_viewer: bool  # True if the viewer could have moved to this head's position


class Tracker:
    """Tracker that filters and predicts one viewer's eye positions.

    `update` takes samples as they arrive, and `at` returns the eye positions for a given time. The first person to be
    seen stays the viewer as long as they are visible. When lost eyes are found again, the output moves smoothly from
    the last shown position to the measured one. When another person becomes the viewer, the output jumps to the new
    viewer's eyes.
    """

    def __init__(
        self,
        settings: TrackerSettings | None = None,
        *,
        panel_m: tuple[float, float] = PANEL_M,
        in_front_m: float = 0.0,
    ) -> None:
        """Create a tracker of eyes with x > `in_front_m`; `panel_m` determines the weight of depth errors."""
        self.settings = settings or TrackerSettings()
        self._panel_m, self._in_front_m = panel_m, in_front_m
        self._measured = NoiseWatch()
        self.replaced = 0  # how often another person has become the viewer
        self._history: deque[_Shown] = deque(maxlen=HISTORY)
        self._other: _Other | None = None
        self._lost_ns: int | None = None
        self._newest_ns = -1
        self._asked_ns = 0  # latest display time that `at` has predicted eyes for

    def update(self, points: EyePoints | None, *, capture_ns: int) -> str:
        """Add a sample in `stack`, None if there was no face. Return why it was refused, or an empty string.

        A sample is refused if it is not newer than the previous one, is uncertain (as in a blink), is implausible for a
        person or is away from the viewer. If two samples in a row are at a position that the viewer could have reached,
        the second one is accepted. Another person's samples are accepted only after the viewer has left.
        """
        if capture_ns <= self._newest_ns:
            if self._newest_ns - capture_ns < CLOCK_RESET_NS:
                return NOT_NEWER
            self.forget()
        self._newest_ns = capture_ns
        if points is None:
            self._lost_ns = capture_ns if self._lost_ns is None else self._lost_ns
            return ""
        if not min(points.confidence.tolist()) >= CONFIDENCE_MIN:
            return UNCERTAIN
        if why := reason_against(points.eyes_m, in_front_m=self._in_front_m):
            return why
        sample = _Sample(capture_ns, HEAD_FROM_EYES @ points.eyes_m, self._noise(points))
        refused = self._take(sample)
        if not refused:
            self._measured.add(sample.head_m, capture_ns=capture_ns)
        return refused

    @property
    def seen_ns(self) -> int | None:
        """Capture time of the newest accepted sample, or None if there is none."""
        return self._history[-1].head.capture_ns if self._history else None

    @property
    def is_established(self) -> bool:
        """True if enough samples have been accepted that the head is not a mistake."""
        return bool(self._history) and self._history[-1].head.samples >= ESTABLISHED

    def reach_m(self, points: EyePoints, *, capture_ns: int) -> tuple[float, float] | None:
        """Return how far a sample is from the head's expected position, and how far it may be. Returns None
        if it is not the same head, because it is too far away, does not continue the head's motion, or the head was not
        seen for longer than `IDENTITY_S`.
        """
        if not self._history:
            return None
        head = self._history[-1].head
        age_s = head.age_s(capture_ns)
        if not 0.0 < age_s <= IDENTITY_S:
            return None
        fast_m = REACH_SPEED * age_s
        moved_m = min(fast_m, HEAD_ACCELERATION * age_s**2 / 2) if head.samples >= ESTABLISHED else fast_m
        sample = _Sample(capture_ns, HEAD_FROM_EYES @ points.eyes_m, self._noise(points))
        noise_m = math.sqrt(np.trace(sample.noise_m2 + SLACK_M2 + head.belief.covariance[0, :3, :3]))
        off_m = float(np.linalg.norm(sample.head_m[0] - imm.ahead(head.moments, min(age_s, HORIZON_S))[0]))
        radius_m = moved_m + 4 * noise_m
        return None if off_m > radius_m or sample.continued(head) is None else (off_m, radius_m)

    def forget(self) -> None:
        """Reset the tracker to its initial state."""
        self._history.clear()
        self._other = self._lost_ns = None
        self._newest_ns, self._asked_ns = -1, 0

    def _noise(self, points: EyePoints) -> F64:
        """Return the (3, 3) covariance of the eyes' midpoint, in m²: the driver's, raised, or the settings'."""
        if points.covariance_m2 is not None and np.isfinite(points.covariance_m2).all():
            noise: F64 = (points.covariance_m2 + points.covariance_m2.T) / 2
            variances, axes = np.linalg.eigh(noise)
            if variances[0] < NOISE_FLOOR_M**2:
                noise = (axes * np.maximum(variances, NOISE_FLOOR_M**2)) @ axes.T
        elif self._measured.sigma_m is not None:
            noise = np.diag(self._measured.sigma_m**2 / 2)
        else:
            noise = self.settings.noise_m**2 / 2 * np.eye(3)
        return noise * COMPLETED_NOISE**2 if points.completed else noise

    def _take(self, sample: _Sample) -> str:
        if not self._history:
            self._follow(sample.begun())
            return ""
        last = self._history[-1]
        age_s = last.head.age_s(sample.capture_ns)
        is_held = self._lost_ns is not None or age_s > HORIZON_S
        head = sample.continued(last.head)
        known = self._other
        again = sample.continued(known.head) if known is not None else None
        if again is not None and last.head.samples < ESTABLISHED and (head is None or again.surprise < head.surprise):
            self._history.clear()  # the viewer's few samples were the mistake
            self._other = None
            self._follow(again)
            return ""
        if head is not None:
            is_others = again is not None and again.surprise < head.surprise and not (known and known.may_be_viewer)
            if head.surprise <= CHI2_DOUBT or not is_others:
                self._follow(head, is_return=is_held)
                return ""
        if known is not None and again is not None:
            other = known._replace(head=again)
        else:
            other = _Other(sample.begun(), sample.is_within_reach_of(last.head))
        is_second = again is not None
        if other.may_be_viewer and (self._lost_ns is not None or is_second):
            self._follow(other.head, is_return=True)
        elif (
            is_second
            and last.head.surprise > CHI2_DOUBT
            and len(self._history) > 1
            and (head := sample.continued(self._history[-2].head))
        ):
            self._history.pop()  # the two newest samples fit better without this entry
            self._follow(head, is_return=True)
        elif age_s > min(ANOTHER_AFTER_S, self.settings.hold_s):
            self._history.clear()
            self.replaced += 1
            self._follow(other.head)
        else:
            self._other = other
            return ELSEWHERE
        return ""

    def _follow(self, head: _Head, *, is_return: bool = False) -> None:
        """Make `head` the viewer's; after a loss or a jump, the position blends from the last one shown."""
        jump_m, jump_ns = (self._history[-1].jump_m, self._history[-1].jump_ns) if self._history else (None, 0)
        if is_return:
            jump_ns = max(self._asked_ns, head.capture_ns)
            before = self.at(jump_ns).eyes_m
            jump_m = None if before is None else before - head.eyes_m(min(head.age_s(jump_ns), HORIZON_S))
        self._history.append(_Shown(head, jump_m, jump_ns))
        self._lost_ns = None
        if self._other is not None and (self._other.may_be_viewer or is_return):
            self._other = None

    def ahead(self, time_ns: int) -> EyesEstimate:
        """Return the same estimate as `at`, for a time without a picture, so that no blend begins."""
        asked_ns = self._asked_ns
        estimate = self.at(time_ns)
        self._asked_ns = asked_ns
        return estimate

    def at(self, time_ns: int) -> EyesEstimate:
        """Return the eyes at a display time on the samples' clock.

        The estimate's label is

        * `exact` at the time of a sample,
        * `interpolated` between two samples,
        * `predicted` up to `HORIZON_S` after the newest sample,
        * `held` once the face is lost and the predicted eyes slow to rest,
        * `none` if the eyes were never seen, were lost for longer than `hold_s` or were forgotten.
        """
        if not self._history or time_ns < self._history[0].head.capture_ns:
            return EyesEstimate(time_ns, 0, None, "none")
        newest = self._history[-1]
        capture_ns = newest.head.capture_ns
        if time_ns <= capture_ns:
            return self._past(time_ns)
        age_s = newest.head.age_s(time_ns)
        if age_s > self.settings.hold_s:
            return EyesEstimate(time_ns, capture_ns, None, "none")
        self._asked_ns = max(self._asked_ns, time_ns)
        label: EyesLabel = "held" if self._lost_ns is not None or age_s > HORIZON_S else "predicted"
        ahead_s = min(age_s, HORIZON_S)
        if self._lost_ns is not None:
            ahead_s = min(age_s, COAST_S)
            known_s = min(newest.head.age_s(self._lost_ns), ahead_s)
            ahead_s = known_s + DECAY_S * -math.expm1(-(ahead_s - known_s) / DECAY_S)
        eyes_m = newest.eyes_m(ahead_s, time_ns)
        return self._estimate(time_ns, newest.head, eyes_m, label)

    def _past(self, time_ns: int) -> EyesEstimate:
        index = bisect_left(self._history, time_ns, key=lambda shown: shown.head.capture_ns)
        after = self._history[index]
        eyes_m = after.eyes_m(0.0, time_ns)
        if after.head.capture_ns == time_ns:
            return self._estimate(time_ns, after.head, eyes_m, "exact")
        before = self._history[index - 1]
        weight = before.head.age_s(time_ns) / before.head.age_s(after.head.capture_ns)
        eyes_m = (1 - weight) * before.eyes_m(0.0, time_ns) + weight * eyes_m
        return self._estimate(time_ns, after.head, eyes_m, "interpolated")

    def _estimate(self, time_ns: int, head: _Head, eyes_m: Eyes, label: EyesLabel) -> EyesEstimate:
        """Return the estimate for `eyes_m`, with a standard deviation that has grown since the sample."""
        age_s = min(max(head.age_s(time_ns), 0.0), SIGMA_AHEAD_S)
        is_past = label in ("exact", "interpolated")
        head_m: F64 = head.moments.mean[:, 0] if is_past else HEAD_FROM_EYES @ eyes_m
        off_m = imm.ahead(head.moments, age_s) - head_m
        error_m2 = imm.spread(head.moments, age_s) + off_m.T @ off_m  # an eye is the midpoint plus or minus the vector
        sigma_m = sideways_sigma_m(error_m2, head_m[0], panel_m=self._panel_m)
        return EyesEstimate(time_ns, head.capture_ns, eyes_m, label, sigma_m)


def sideways_sigma_m(error_m2: F64, eye_m: F64, *, panel_m: tuple[float, float]) -> float:
    """Return the sideways standard deviation with the same effect on the display as a position error.

    If an eye is nearer than its estimated distance x by d, the effect on a point on the display is that of a sideways
    displacement of d·u/x, where u is the distance from the point to the foot of the perpendicular from the eye to the
    display. The result is the root mean square over the display. `error_m2` (3, 3) belongs to the eyes' midpoint.
    """
    x, y, z = eye_m.tolist()
    x = max(x, NEAREST_M)
    (xx, xy, xz), (_, yy, _), (_, _, zz) = error_m2.tolist()
    lever2 = (y * y + z * z + (panel_m[0] ** 2 + panel_m[1] ** 2) / 12) / (x * x)
    both = yy + zz - 2 * (y * xy + z * xz) / x
    return math.sqrt(max(both + lever2 * xx, 0.0) / 2)
