"""From a sensor's samples to the eyes at any instant: map, track, tell rest; with the settings of the moment."""

from __future__ import annotations

import logging
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from runtime.clock import NS_PER_S
from runtime.config import Settings
from runtime.eyes.calibration import Calibration
from runtime.eyes.calibration_drift import SeparationWatch
from runtime.eyes.plausibility import PlausibilityWatch
from runtime.eyes.rest import RestWatch
from runtime.eyes.tracker import Tracker
from runtime.records import EyesEstimate, SensorFrame

log = logging.getLogger("phasestack.viewer")

IN_FRONT_M = 0.01  # nearer to the front panel than this, or behind it, no eye is served


class Viewer:
    """One viewer's eyes in the `stack` frame. One thread uses it; it never reads a clock."""

    def __init__(
        self, settings: Settings, calibration: Calibration, *, front_m: float, in_stack_frame: bool = False
    ) -> None:
        """front_m: x of the front panel; in_stack_frame: the sensor's points need no calibration."""
        self._settings, self._calibration = settings, calibration
        self._front_m, self._in_stack_frame = front_m, in_stack_frame
        self._tracker = Tracker(settings.tracker)
        self._rest = _rest_watch(settings)
        self._drift = _drift_watch(settings)
        self._plausible = _plausibility_watch(settings)
        self._serial_checked = False
        self._captures_ns: deque[int] = deque(maxlen=64)
        self.dropped: Counter[str] = Counter()  # eyes that were not used, by reason

    def adopt(self, settings: Settings, calibration: Calibration) -> None:
        """Other settings hold from now on. The tracker forgets only where its own have changed."""
        before, self._settings, self._calibration = self._settings, settings, calibration
        if settings.tracker != before.tracker:
            self._tracker = Tracker(settings.tracker)
            self._plausible = _plausibility_watch(settings)
        if (settings.plan, settings.model) != (before.plan, before.model):
            self._rest = _rest_watch(settings)
        if settings.calibration != before.calibration:
            self._drift = _drift_watch(settings)

    @property
    def warning(self) -> str:
        """What most samples of late can't be (exchanged, in millimetres, ...); empty: all is well."""
        return self._plausible.warning

    @property
    def implausible(self) -> Mapping[str, int]:
        """Samples that can't be a viewer's eyes, by reason."""
        return self._plausible.counts

    @property
    def outliers(self) -> int:
        """Samples that the tracker refused."""
        return self._tracker.outliers

    @property
    def rate_hz(self) -> float | None:
        """Samples a second, by the newest ones' captures; None before there are two."""
        if len(self._captures_ns) < 2 or self._captures_ns[-1] <= self._captures_ns[0]:
            return None
        return round((len(self._captures_ns) - 1) * NS_PER_S / (self._captures_ns[-1] - self._captures_ns[0]), 2)

    def take(self, frame: SensorFrame, *, serial: str) -> None:
        """One sample, as it came."""
        self._captures_ns.append(frame.capture_ns)
        points = frame.eyes
        if points is not None and not self._in_stack_frame:
            points = self._calibration.apply(points)
            if drift := self._drift.update(points):
                log.warning("%s", drift)
        if points is not None and (told := self._plausible.update(points.eyes_m)):
            log.warning("%s", told)
        self._tracker.update(points, capture_ns=frame.capture_ns)
        if self._rest is not None and points is not None:
            self._rest.update(points.eyes_m, capture_ns=frame.capture_ns)
        if not self._serial_checked and serial:
            self._serial_checked = True
            if warning := self._calibration.serial_warning(serial):
                log.warning("%s", warning)

    def at(self, light_ns: int) -> EyesEstimate:
        """The eyes at the light of a refresh: what is shown next is aligned to them."""
        return self._served(self._tracker.at(light_ns))

    def ahead(self, time_ns: int) -> EyesEstimate:
        """The eyes at an instant that is not shown yet: for the solver."""
        return self._served(self._tracker.ahead(time_ns), count=False)

    def _served(self, eyes: EyesEstimate, *, count: bool = True) -> EyesEstimate:
        """Where the head rests, as long as it does; without eyes that can't see every panel from the front."""
        if eyes.eyes_m is None:
            return eyes
        place = self._rest.place if self._rest is not None else None
        if place is not None:
            assert self._rest is not None
            label = eyes.label if eyes.label == "held" else "rested"
            eyes = replace(eyes, eyes_m=place, label=label, sigma_m=self._rest.sigma_m)
        assert eyes.eyes_m is not None
        if np.isfinite(eyes.eyes_m).all() and float(eyes.eyes_m[:, 0].min()) > self._front_m + IN_FRONT_M:
            return eyes
        if count:
            self.dropped["not in front of the panels"] += 1
            log.warning("eyes: at %s, not in front of the panels: dropped", np.round(eyes.eyes_m, 3).tolist())
        return EyesEstimate(eyes.time_ns, eyes.capture_ns, None, "none", eyes.age_ns)


def _rest_watch(settings: Settings) -> RestWatch | None:
    """None where the plan may not show a picture again for eyes that are only nearly the same."""
    plan = settings.plan
    most_m = (plan.dead_band_mm or plan.most_band_mm) / 1000
    return RestWatch(most_m=most_m) if plan.enabled and plan.reuse and most_m > 0 else None


def _plausibility_watch(settings: Settings) -> PlausibilityWatch:
    return PlausibilityWatch(ipd_min_m=settings.tracker.ipd_min_m, ipd_max_m=settings.tracker.ipd_max_m)


def _drift_watch(settings: Settings) -> SeparationWatch:
    return SeparationWatch(known_ipd_m=settings.calibration.ipd_m, tolerance=settings.calibration.ipd_tolerance)
