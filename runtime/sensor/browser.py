"""Driver `browser`: web pages' pointers move virtual heads, or a page's camera sees the viewer."""

from __future__ import annotations

from collections import deque
from math import hypot, radians
from typing import Any

import cv2
import numpy as np

from runtime.browser.link import BrowserLink, SeenEyes
from runtime.clock import NS_PER_MS, NS_PER_S, Clock
from runtime.errors import SensorLost, SensorTimeout
from runtime.optics.alignment import midpoints
from runtime.records import F64, EyePoints, Eyes, Intrinsics, SensorFrame
from runtime.sensor.base import Capabilities, DeviceClock, Sensor
from runtime.support.picture_header import picture_size

AGAIN_NS = NS_PER_S // 30  # the last positions are repeated at this interval, because pages report only movements
SILENT_NS = 20 * NS_PER_S  # a head is gone after this time without a message; busy pages are silent for seconds
AHEAD_NS = NS_PER_S // 20  # a moving head whose page is late is extrapolated for at most this long
PEAK_M_S2 = 12.0  # peak acceleration of pages' heads
LEAST_SIGMA_M = 5e-5  # lower limit, so that noise-free samples have a regular covariance
PICTURE_MAX_PX = 2048  # maximum length of the longer side of a page's camera picture


class _Head:
    """Head that a page moves, as of its last sample."""

    def __init__(self, now_ns: int) -> None:
        self._times, self._heard_ns, self._captured_ns = DeviceClock(), now_ns, now_ns
        self._last = SeenEyes(None, 0.0)

    def take(self, sample: SeenEyes, now_ns: int) -> int:
        """Add a sample that has just arrived, and return its capture time."""
        self._captured_ns = self._times.host_ns(round(sample.page_ms * NS_PER_MS), arrival_ns=now_ns)
        self._heard_ns, self._last = now_ns, sample
        return self._captured_ns

    def at(self, time_ns: int, now_ns: int) -> tuple[Eyes, float] | None:
        """Return the eyes at a time and their error's standard deviation, or None if the head is gone."""
        eyes_m, velocity_m_s = self._last.eyes_m, self._last.velocity_m_s
        if eyes_m is None or now_ns - self._heard_ns > SILENT_NS:
            return None
        if velocity_m_s is None:
            return eyes_m, 0.0
        ahead_s = min(max(time_ns - self._captured_ns, 0), AHEAD_NS) / NS_PER_S
        return eyes_m + ahead_s * velocity_m_s, PEAK_M_S2 / 2 * ahead_s**2


class BrowserEyes(Sensor):
    """Driver that delivers the eye positions sent by pages, and repeats the last positions in between."""

    name = "browser"
    capabilities = Capabilities(eye_points=True, in_stack_frame=True, may_pause=True)

    def __init__(self, link: BrowserLink, clock: Clock) -> None:
        self._link, self._clock = link, clock
        self._random = np.random.default_rng(0)
        self._waiting: deque[tuple[int, SensorFrame]] | None = None  # arrival times and samples
        self._heads: list[_Head] = []
        self._sampled_ns = self._captured_ns = self._count = 0

    def open(self) -> None:
        self._waiting, self._sampled_ns = deque(), self._clock.now_ns()
        self._heads = [_Head(self._sampled_ns) for _ in range(self._link.mode.heads)]

    def read_newest(self, timeout_s: float) -> SensorFrame:
        *overtaken, newest = self.read_arrived(timeout_s)
        self.skipped += len(overtaken)
        return newest

    def read_arrived(self, timeout_s: float) -> list[SensorFrame]:
        if self._waiting is None:
            raise SensorLost("the browser's sensor is not open")
        while True:
            now_ns = self._clock.now_ns()
            due = []
            while self._waiting and self._waiting[0][0] <= now_ns:
                due.append(self._waiting.popleft()[1])
            if due:
                return due
            next_ns = min([self._sampled_ns + AGAIN_NS, *(due_ns for due_ns, _ in self._waiting)])
            samples = self._link.seen(max(next_ns - now_ns, 0) / NS_PER_S)
            now_ns = self._clock.now_ns()
            for sample in samples:
                capture_ns = self._heads[sample.head].take(sample, now_ns)
                self._link.captured(capture_ns, sample)
                self._take(capture_ns, now_ns)
            if not samples and now_ns - self._sampled_ns >= AGAIN_NS:
                self._take(now_ns, now_ns)

    def _take(self, capture_ns: int, now_ns: int) -> None:
        assert self._waiting is not None
        self._sampled_ns = now_ns
        self._captured_ns = capture_ns = max(capture_ns, self._captured_ns + 1)  # keep captures in order
        self._count += 1
        heads = [head.at(capture_ns, now_ns) for head in self._heads]
        present = sorted((head for head in heads if head is not None), key=lambda head: _distance_m(head[0]))
        people = tuple(self._measured(*head) for head in present)
        true_m = None
        if people or len(heads) > 1:
            true_m = np.concatenate([np.full((2, 3), np.nan) if head is None else head[0] for head in heads])
        first = people[0] if people else None
        frame = SensorFrame(self._count, capture_ns, first, true_eyes_m=true_m, others=people[1:])
        due_ns = now_ns + round(self._link.sensor.latency_ms * NS_PER_MS)
        self._waiting.append((due_ns, frame))

    def _measured(self, eyes_m: F64, error_m: float) -> EyePoints:
        noise_mm = self._link.sensor.noise_mm
        sigma_m = hypot(max(noise_mm * 1e-3, LEAST_SIGMA_M), error_m)
        noise_m = self._random.normal(size=3) * noise_mm * 1e-3
        return EyePoints(eyes_m + noise_m, np.ones(2), covariance_m2=np.eye(3) * sigma_m**2)

    def close(self) -> None:
        self._waiting = None


class BrowserCamera(Sensor):
    """Driver of a web page's camera frames. The distance is estimated from the eye separation."""

    name = "browser"
    capabilities = Capabilities(colour=True)

    def __init__(self, link: BrowserLink, clock: Clock) -> None:
        self._link, self._clock = link, clock
        self._times, self._number, self._captured_ns = DeviceClock(), 0, 0

    def open(self) -> None:
        self._times = DeviceClock()

    def read_newest(self, timeout_s: float) -> SensorFrame:
        message = self._link.picture(timeout_s)
        if message is None:
            raise SensorTimeout("the page has not sent a camera picture")
        coded, page_ms = message
        capture_ns = self._times.host_ns(round(page_ms * NS_PER_MS), arrival_ns=self._clock.now_ns())
        self._link.captured(capture_ns, SeenEyes(None, page_ms))
        picture = _decoded(coded)
        self._number += 1
        self._captured_ns = max(capture_ns, self._captured_ns + 1)
        height, width = picture.shape[:2]
        intrinsics = Intrinsics.centred(width, height, fov_rad=radians(self._link.sensor.camera_fov_deg))
        colour = np.ascontiguousarray(picture[..., ::-1])
        return SensorFrame(self._number, self._captured_ns, colour=colour, intrinsics=intrinsics)

    def close(self) -> None:
        """Do nothing, because there is no device to release."""


def _distance_m(eyes_m: F64) -> float:
    return float(np.linalg.norm(midpoints(eyes_m)))


def _decoded(coded: bytes) -> Any:
    """Return a picture as BGR. Raises SensorTimeout if it is damaged or too large; the size is checked first."""
    try:
        width, height = picture_size(coded)
    except ValueError as error:
        raise SensorTimeout(f"the page sent a camera picture that {error}") from None
    if max(width, height) > PICTURE_MAX_PX:
        size = f"{width} by {height} pixels; the maximum is {PICTURE_MAX_PX}"
        raise SensorTimeout(f"the page sent a camera picture of {size}")
    picture: Any = cv2.imdecode(np.frombuffer(coded, np.uint8), cv2.IMREAD_COLOR)
    if picture is None:
        raise SensorTimeout("the page sent a camera picture that cannot be decoded")
    return picture
