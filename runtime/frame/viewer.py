"""Estimate where the viewer's eyes are at any time, by calibrating and tracking the sensor's samples."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Mapping, Sequence

import numpy as np

from runtime.clock import NS_PER_S
from runtime.config import TWO_VIEWERS_PANELS, Settings
from runtime.eyes.calibration import Calibration
from runtime.eyes.people import People, Person
from runtime.eyes.plausibility import RefusalWatch
from runtime.eyes.rest import RestWatch
from runtime.eyes.tracker import Tracker
from runtime.records import EyesEstimate, EyesLabel, SensorFrame

log = logging.getLogger("phasestack.viewer")

MAX_REST_DRIFT_M = 0.001  # if a resting head drifts farther than this, its position is updated
IN_FRONT_M = 0.01  # eyes that are not at least this far in front of the front panel are ignored


class Viewer:
    """Estimates the eyes of the people who are served, in the `stack` frame, from a sensor's samples.
    Calibrates the samples, tracks the eyes, and detects which heads are at rest. Not thread-safe. Never reads a clock.
    """

    def __init__(
        self, settings: Settings, calibration: Calibration, *, front_m: float, in_stack_frame: bool = False
    ) -> None:
        """Create an estimator for people in front of a front panel at x = `front_m`, not seen yet."""
        self._settings, self.calibration = settings, calibration
        self._nearest_m, self._in_stack_frame = front_m + IN_FRONT_M, in_stack_frame
        self._people = self._new_people()
        self._refusals = RefusalWatch()
        self._serial_checked = False
        self._captures_ns: deque[int] = deque(maxlen=64)

    def adopt(self, settings: Settings, calibration: Calibration | None = None) -> None:
        """Adopt new settings and perhaps a new calibration. Trackers are reset only if theirs have changed."""
        before, self._settings, self.calibration = self._settings, settings, calibration or self.calibration
        if settings.tracker != before.tracker:
            self._people = self._new_people()
        if (settings.plan, settings.model) != (before.plan, before.model):
            self._people.renew_rest()

    def _new_people(self) -> People:
        settings = self._settings
        if settings.most_viewers > 1 and (count := len(settings.stack.x_m)) < TWO_VIEWERS_PANELS:
            log.warning("tracker.viewers: while %d panels serve two people, each sees about 6 dB less", count)
        return People(
            self._new_tracker,
            lambda: _rest_watch(self._settings),
            most_served=settings.most_viewers,
            join_s=settings.tracker.join_s,
            in_front_m=self._nearest_m,
        )

    def _new_tracker(self) -> Tracker:
        stack = self._settings.stack
        panel_m = stack.width_m, stack.height_m
        return Tracker(self._settings.tracker, panel_m=panel_m, in_front_m=self._nearest_m)

    @property
    def in_view(self) -> int:
        """Number of people in front of the display, whether or not they are served."""
        return self._people.in_view

    @property
    def warning(self) -> str:
        """Reason why most recent samples are implausible, such as swapped eyes; "" if they are not."""
        return self._refusals.warning

    @property
    def refused(self) -> Mapping[str, int]:
        """Number of samples refused by the tracker, keyed by reason."""
        return self._refusals.counts

    @property
    def rate_hz(self) -> float | None:
        """Recent sampling rate in samples per second, or None if fewer than two samples have been captured."""
        if len(self._captures_ns) < 2 or self._captures_ns[-1] <= self._captures_ns[0]:
            return None
        return round((len(self._captures_ns) - 1) * NS_PER_S / (self._captures_ns[-1] - self._captures_ns[0]), 2)

    def take(self, frame: SensorFrame, *, serial: str) -> None:
        """Process a sample of the sensor with this serial number or "". If the tracker refuses it, only count
        it.
        """
        self._captures_ns.append(frame.capture_ns)
        people = frame.people if self._in_stack_frame else [self.calibration.apply(points) for points in frame.people]
        for refused in self._people.update(people, capture_ns=frame.capture_ns):
            if line := self._refusals.update(refused):
                log.warning("%s", line)
        if not self._serial_checked and serial:
            self._serial_checked = True
            if warning := self.calibration.serial_warning(serial):
                log.warning("%s", warning)

    def at(self, display_ns: int) -> EyesEstimate:
        """Return the eyes at a refresh's display time, used to align the solution it shows."""
        return together([self._served(person, person.tracker.at(display_ns)) for person in self._people.served])

    def ahead(self, time_ns: int) -> EyesEstimate:
        """Return the eyes at a later time, used by the solver to compute a solution."""
        return together([self._served(person, person.tracker.ahead(time_ns)) for person in self._people.served])

    def _served(self, person: Person, eyes: EyesEstimate) -> EyesEstimate:
        """Return a person's eyes, corrected in two ways. If the head is at rest, its fixed eye positions are used
        instead. Eyes behind or too close to the front panel are removed.
        """
        rest, numbers = person.rest, (person.number,)
        if eyes.eyes_m is None:
            return eyes
        if rest is not None and rest.place is not None:
            label: EyesLabel = eyes.label if eyes.label == "held" else "rested"
            return EyesEstimate(eyes.time_ns, eyes.capture_ns, rest.place, label, rest.sigma_m, numbers)
        if float(eyes.eyes_m[:, 0].min()) <= self._nearest_m:
            return EyesEstimate(eyes.time_ns, eyes.capture_ns, None, "none")
        return EyesEstimate(eyes.time_ns, eyes.capture_ns, eyes.eyes_m, eyes.label, eyes.sigma_m, numbers)


def together(estimates: Sequence[EyesEstimate]) -> EyesEstimate:
    """Combine the estimates for several people at the same instant into one. The label is theirs if it is
    the same for all, and otherwise `predicted`.
    """
    known = [each for each in estimates if each.eyes_m is not None]
    if len(known) < 2:
        return known[0] if known else estimates[0]
    labels = {each.label for each in known}
    return EyesEstimate(
        known[0].time_ns,
        max(each.capture_ns for each in known),
        np.concatenate([each.eyes_m for each in known if each.eyes_m is not None]),
        labels.pop() if len(labels) == 1 else "predicted",
        float(np.sqrt(np.mean([each.sigma_m**2 for each in known]))),
        tuple(number for each in known for number in each.people),
    )


def _rest_watch(settings: Settings) -> RestWatch | None:
    """Create a detector for a head at rest, or return None if `plan.enabled` is off."""
    return RestWatch(max_drift_m=MAX_REST_DRIFT_M) if settings.plan.enabled else None
