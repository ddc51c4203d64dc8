"""Detect points that cannot be eyes, such as points in millimetres or behind the display."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Mapping

from runtime.records import Eyes

NOT_NEWER = "not newer than the previous sample"
NOT_A_NUMBER = "not a number"
MILLIMETRES = "in millimetres, not metres"
TOO_CLOSE = "too close together for a person"
TOO_FAR_APART = "too far apart for a person"
BEHIND = "not in front of the panels"
TOO_DISTANT = "too far away for a viewer"
EXCHANGED = "left and right swapped"

IPD_MIN_M, IPD_MAX_M = 0.050, 0.078  # range of people's eye separations
WINDOW = 30  # number of recent samples examined: one second with a typical depth camera
SAMPLES_MIN = 10  # minimum number of samples needed before a reason is reported
WARNING_SHARE = 0.5  # warn if more than this share of samples is refused for the same reason
UNIT_SLACK = 1.25  # factor to widen the limits by when checking for millimetres
DISTANT_M = 20.0  # no sensor sees a face farther from the display than this
UPSIDE_DOWN_COSINE = -0.5  # the eyes count as swapped if the head seems rolled by more than 120 degrees

MISTAKES = (NOT_NEWER, NOT_A_NUMBER, MILLIMETRES, TOO_CLOSE, TOO_FAR_APART, BEHIND, TOO_DISTANT, EXCHANGED)
_HINTS = {
    NOT_NEWER: "the driver must report the capture time of each sample",
    MILLIMETRES: "the driver must deliver metres",
    EXCHANGED: "`left` must be the viewer's left eye, and the camera's picture must not be mirrored",
    BEHIND: "calibrate again; the calibration may be for another sensor",
    TOO_DISTANT: "calibrate again; the calibration may be for another sensor",
}


def reason_against(eyes_m: Eyes, *, in_front_m: float = 0.0) -> str:
    """Return why two points cannot be a viewer's left and right eye, or an empty string if they can. The
    eyes count as swapped if the vector from the left eye to the right eye points to the viewer's left. Both must have x
    > `in_front_m`.
    """
    (lx, ly, lz), (rx, ry, rz) = eyes_m.tolist()
    if not all(map(math.isfinite, (lx, ly, lz, rx, ry, rz))):
        return NOT_A_NUMBER
    apart_m = math.hypot(rx - lx, ry - ly, rz - lz)
    if IPD_MIN_M / UNIT_SLACK <= apart_m / 1000 <= IPD_MAX_M * UNIT_SLACK:
        return MILLIMETRES
    if not IPD_MIN_M <= apart_m <= IPD_MAX_M:
        return TOO_CLOSE if apart_m < IPD_MIN_M else TOO_FAR_APART
    mx, my, mz = (lx + rx) / 2, (ly + ry) / 2, (lz + rz) / 2
    if math.hypot(mx, my, mz) > DISTANT_M:
        return TOO_DISTANT
    if min(lx, rx) <= in_front_m:
        return BEHIND
    # For a viewer facing the display, right is up × the direction to the eyes: (-my, mx, 0).
    towards_right = (-my * (rx - lx) + mx * (ry - ly)) / math.hypot(mx, my) / apart_m
    return EXCHANGED if towards_right < UPSIDE_DOWN_COSINE else ""


class RefusalWatch:
    """Counter for refused samples. It warns once if most samples are refused for the same reason."""

    def __init__(self) -> None:
        self._last: deque[str] = deque(maxlen=WINDOW)
        self._counts: Counter[str] = Counter()
        self.warning = ""  # current warning, or an empty string

    @property
    def counts(self) -> Mapping[str, int]:
        """Number of samples refused for each reason."""
        return self._counts

    def update(self, reason: str) -> str:
        """Count a sample, refused or accepted (""). Return a line to log if the warning has changed, or ""."""
        self._last.append(reason if reason in MISTAKES else "")
        if reason:
            self._counts[reason] += 1
        if len(self._last) < SAMPLES_MIN:
            return ""
        commonest, count = Counter(filter(None, self._last)).most_common(1)[0] if any(self._last) else ("", 0)
        before = self.warning
        if count > WARNING_SHARE * len(self._last):
            hint = f"; {_HINTS[commonest]}" if commonest in _HINTS else ""
            self.warning = f"sensor: the eyes are {commonest}{hint}"
            return self.warning if self.warning != before else ""
        if before and count < WARNING_SHARE / 2 * len(self._last):
            self.warning = ""
            return "sensor: the eyes are plausible again"
        return ""
