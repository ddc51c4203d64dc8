"""Estimate where the viewer's eyes are at any time, by calibrating and tracking the sensor's samples."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Mapping
from dataclasses import replace

from runtime.clock import NS_PER_S
from runtime.config import Settings
from runtime.eyes.calibration import Calibration
from runtime.eyes.plausibility import RefusalWatch
from runtime.eyes.rest import RestWatch
from runtime.eyes.tracker import Tracker
from runtime.records import EyesEstimate, SensorFrame

log = logging.getLogger("phasestack.viewer")

MAX_REST_DRIFT_M = 0.001  # if a resting head drifts farther than this, its position is updated
IN_FRONT_M = 0.01  # eyes that are not at least this far in front of the front panel are ignored


class Viewer:
    """Estimates one viewer's eyes in the `stack` frame from a sensor's samples.

    Calibrates the samples, tracks the eyes, and detects when the head is at rest. Not thread-safe. Never reads a clock.
    """

    def __init__(
        self, settings: Settings, calibration: Calibration, *, front_m: float, in_stack_frame: bool = False
    ) -> None:
        """Create an estimator for a viewer who has not been seen yet.

        Args:
            calibration: The sensor's calibration.
            front_m: The front panel's x coordinate in the `stack` frame.
            in_stack_frame: True if the sensor's measurements are already in the `stack` frame.
        """
        self._settings, self._calibration = settings, calibration
        self._nearest_m, self._in_stack_frame = front_m + IN_FRONT_M, in_stack_frame
        self._tracker = self._new_tracker()
        self._rest = _rest_watch(settings)
        self._refusals = RefusalWatch()
        self._serial_checked = False
        self._captures_ns: deque[int] = deque(maxlen=64)

    def adopt(self, settings: Settings, calibration: Calibration) -> None:
        """Adopt new settings and a new calibration.

        The tracker is reset only if its settings have changed.
        """
        before, self._settings, self._calibration = self._settings, settings, calibration
        if settings.tracker != before.tracker:
            self._tracker = self._new_tracker()
        if (settings.plan, settings.model) != (before.plan, before.model):
            self._rest = _rest_watch(settings)

    def _new_tracker(self) -> Tracker:
        stack = self._settings.stack
        panel_m = stack.width_m, stack.height_m
        return Tracker(self._settings.tracker, panel_m=panel_m, in_front_m=self._nearest_m)

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
        """Process a sample. If the tracker refuses it, only count it.

        Args:
            frame: The sample.
            serial: The sensor's serial number, or "" if it is unknown.
        """
        self._captures_ns.append(frame.capture_ns)
        points = frame.eyes
        if points is not None and not self._in_stack_frame:
            points = self._calibration.apply(points)
        refused = self._tracker.update(points, capture_ns=frame.capture_ns)
        if points is not None:
            if line := self._refusals.update(refused):
                log.warning("%s", line)
            if not refused and self._rest is not None:
                self._rest.update(points.eyes_m, capture_ns=frame.capture_ns)
        if not self._serial_checked and serial:
            self._serial_checked = True
            if warning := self._calibration.serial_warning(serial):
                log.warning("%s", warning)

    def at(self, display_ns: int) -> EyesEstimate:
        """Return the eyes at a refresh's display time, used to align the solution it shows."""
        return self._served(self._tracker.at(display_ns))

    def ahead(self, time_ns: int) -> EyesEstimate:
        """Return the eyes at a later time, used by the solver to compute a solution."""
        return self._served(self._tracker.ahead(time_ns))

    def _served(self, eyes: EyesEstimate) -> EyesEstimate:
        """Return `eyes`, corrected in two ways.

        If the head is at rest, its fixed eye positions are used instead. Eyes behind or too close to the front panel
        are removed.
        """
        if eyes.eyes_m is None:
            return eyes
        if self._rest is not None and self._rest.place is not None:
            label = eyes.label if eyes.label == "held" else "rested"
            return replace(eyes, eyes_m=self._rest.place, label=label, sigma_m=self._rest.sigma_m)
        if float(eyes.eyes_m[:, 0].min()) <= self._nearest_m:
            return EyesEstimate(eyes.time_ns, eyes.capture_ns, None, "none")
        return eyes


def _rest_watch(settings: Settings) -> RestWatch | None:
    """Create a detector for a head at rest, or return None if `plan.enabled` is off."""
    return RestWatch(max_drift_m=MAX_REST_DRIFT_M) if settings.plan.enabled else None
