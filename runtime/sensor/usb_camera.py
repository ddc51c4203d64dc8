"""Driver `usb-camera`: a webcam by V4L2, without depth: distance from the eyes' separation."""

from __future__ import annotations

import re
from math import radians, tan
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from runtime.clock import NS_PER_MS, NS_PER_S, Clock
from runtime.config import SensorSettings
from runtime.errors import InputError, SensorLost
from runtime.records import Intrinsics, SensorFrame
from runtime.sensor.base import Capabilities, Sensor
from runtime.support.film import open_film

WAITED_NS = 3 * NS_PER_MS  # a picture that comes sooner lay in the driver's queue, and a newer one may
QUEUE_MAX = 8  # pictures that one read takes out of the driver's queue at most
STAMP_AGE_NS = NS_PER_S  # a picture's stamp that is older, or in the future, is none
STREAMS = ("rtsp", "rtsps", "http", "https")  # what else FFmpeg takes for an address may listen, or open other files


class UsbCameraDriver(Sensor):
    """The newest picture, dated by the kernel when its light had come in."""

    name = "usb-camera"
    capabilities = Capabilities(colour=True)

    def __init__(self, settings: SensorSettings, clock: Clock) -> None:
        """settings.source: empty or `demo`: the first camera; a number, a device, or an address of `STREAMS`.

        Raises InputError for another address, or without a field of view, which no webcam reports.
        """
        if not settings.fov_deg:
            raise InputError("sensor", "fov_deg", "is needed by usb-camera: the picture's horizontal angle, degrees")
        source = settings.source if settings.source != "demo" else ""
        protocol = re.match(r"([\w+.-]+):", source)
        if protocol is not None and protocol[1] not in STREAMS:
            raise InputError("sensor", "source", f"{protocol[1]}: is no camera's address: {', '.join(STREAMS)} are")
        self._source = f"/dev/video{source or 0}" if re.fullmatch(r"\d*", source) else source
        self._fov, self._clock = radians(settings.fov_deg), clock
        self._capture: Any = None
        self._number = 0

    @property
    def _is_device(self) -> bool:
        return self._source.startswith("/dev/")

    def open(self) -> None:
        self.close()
        if self._is_device and not Path(self._source).exists():
            raise SensorLost(f"{self._source}: there is no such camera")
        capture = self._opened()
        if not capture.isOpened():
            capture.release()
            raise SensorLost(
                f"{self._source}: cannot be opened (another program has it, or no permission: group video)"
            )
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        self._capture = capture

    def _opened(self) -> cv2.VideoCapture:
        if self._is_device or "://" in self._source:
            return cv2.VideoCapture(self._source, cv2.CAP_V4L2 if self._is_device else cv2.CAP_FFMPEG)
        return open_film(Path(self._source))

    def read_newest(self, timeout_s: float) -> SensorFrame:
        if self._capture is None:
            raise SensorLost("not open")
        for _ in range(QUEUE_MAX):
            begin_ns = self._clock.now_ns()
            if not self._capture.grab():  # waits for the next one; the worker's own time-out knows of one that hangs
                raise SensorLost(f"{self._source}: delivers no more pictures")
            self._number += 1
            now_ns = self._clock.now_ns()
            if not self._is_device or now_ns - begin_ns > WAITED_NS:
                break
            self.skipped += 1
        done, bgr = self._capture.retrieve()
        if not done:
            raise SensorLost(f"{self._source}: a picture that can't be decoded")
        stamp_ns = round(self._capture.get(cv2.CAP_PROP_POS_MSEC) * NS_PER_MS)
        is_stamp = self._is_device and 0 <= now_ns - stamp_ns < STAMP_AGE_NS
        height, width = bgr.shape[:2]
        focal = width / 2 / tan(self._fov / 2)
        return SensorFrame(
            self._number,
            stamp_ns if is_stamp else now_ns,
            colour=np.ascontiguousarray(bgr[..., ::-1]),
            intrinsics=Intrinsics(width, height, focal, focal, width / 2, height / 2),
        )

    def close(self) -> None:
        if self._capture is not None:
            self._capture.release()
            self._capture = None
