"""What can't be a viewer's two eyes, and why: left and right exchanged, millimetres, behind the display.

The tracker refuses what it can't believe; this says which mistake it looks like, and counts. Pure of time and of
clocks; eyes are in frame `stack` (+x out of the screen, +y the viewer's right, +z up), metres.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Mapping

from runtime.records import F64

NOT_A_NUMBER = "not a number"
MILLIMETRES = "in millimetres, not metres"
CENTIMETRES = "in centimetres, not metres"
TOO_CLOSE = "too close together for a person"
TOO_FAR_APART = "too far apart for a person"
BEHIND = "behind the display"
TOO_DISTANT = "too distant for a viewer"
EXCHANGED = "left and right exchanged"

WINDOW = 30  # samples: a second of a common depth camera
LEAST_SAMPLES = 10
TELL_SHARE = 0.5  # of the window, for one reason
UNIT_SLACK = 1.25  # a separation of 40 to 94 units is one in millimetres: people's is 50 to 75 mm
DISTANT_M = 20.0
UPSIDE_DOWN_COSINE = -0.5  # a head rolled by more than 120 degrees is an exchange of its eyes

_HINTS = {
    MILLIMETRES: "the driver must deliver metres",
    CENTIMETRES: "the driver must deliver metres",
    EXCHANGED: "`left` is the viewer's own left; or the calibration is of a mirrored picture",
    BEHIND: "calibrate again, or the calibration is another sensor's",
    TOO_DISTANT: "calibrate again, or the calibration is another sensor's",
}


def reason_against(eyes_m: F64, *, ipd_min_m: float, ipd_max_m: float) -> str:
    """Why (2, 3) left and right eye can't be a viewer's, or an empty text.

    An exchange shows in the line from left to right: across the line of sight, level, it points to the viewer's right.
    """
    (lx, ly, lz), (rx, ry, rz) = eyes_m.tolist()
    if not all(map(math.isfinite, (lx, ly, lz, rx, ry, rz))):
        return NOT_A_NUMBER
    apart_m = math.hypot(rx - lx, ry - ly, rz - lz)
    for unit, per_metre in ((MILLIMETRES, 1000.0), (CENTIMETRES, 100.0)):
        if ipd_min_m / UNIT_SLACK <= apart_m / per_metre <= ipd_max_m * UNIT_SLACK:
            return unit
    if not ipd_min_m <= apart_m <= ipd_max_m:
        return TOO_CLOSE if apart_m < ipd_min_m else TOO_FAR_APART
    mx, my, mz = (lx + rx) / 2, (ly + ry) / 2, (lz + rz) / 2
    if math.hypot(mx, my, mz) > DISTANT_M:
        return TOO_DISTANT
    if mx <= 0.0:
        return BEHIND
    # Up x the direction to the eyes is the viewer's right: (-my, mx, 0), for a viewer who looks at the display.
    towards_right = (-my * (rx - lx) + mx * (ry - ly)) / math.hypot(mx, my) / apart_m
    return EXCHANGED if towards_right < UPSIDE_DOWN_COSINE else ""


class PlausibilityWatch:
    """Counts by reason, and says so once where most samples have one and the same."""

    def __init__(self, *, ipd_min_m: float, ipd_max_m: float) -> None:
        self._ipd_m = (ipd_min_m, ipd_max_m)
        self._last: deque[str] = deque(maxlen=WINDOW)
        self._counts: Counter[str] = Counter()
        self.warning = ""  # what is wrong at present; empty: nothing

    @property
    def counts(self) -> Mapping[str, int]:
        """Samples that can't be a viewer's eyes, by reason."""
        return self._counts

    def update(self, eyes_m: F64) -> str:
        """Take in (2, 3) eyes in frame `stack`. Answers a line to log when the state changes, else an empty text."""
        reason = reason_against(eyes_m, ipd_min_m=self._ipd_m[0], ipd_max_m=self._ipd_m[1])
        self._last.append(reason)
        if reason:
            self._counts[reason] += 1
        if len(self._last) < LEAST_SAMPLES:
            return ""
        commonest, count = Counter(filter(None, self._last)).most_common(1)[0] if any(self._last) else ("", 0)
        before = self.warning
        if count > TELL_SHARE * len(self._last):
            hint = f": {_HINTS[commonest]}" if commonest in _HINTS else ""
            self.warning = f"sensor: the eyes are {commonest}{hint}"
            return self.warning if self.warning != before else ""
        if before and count < TELL_SHARE / 2 * len(self._last):
            self.warning = ""
            return "sensor: the eyes are plausible again"
        return ""
