"""Driver `usb-camera`: webcams through V4L2, video files and network streams.

Webcams do not measure depth, so the viewer's distance is estimated from the eye separation.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import chain
from math import radians
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from runtime.clock import NS_PER_MS, NS_PER_S, Clock
from runtime.config import SensorSettings
from runtime.errors import InputError, SensorLost
from runtime.records import U8, Intrinsics, SensorFrame
from runtime.sensor.base import Capabilities, Sensor
from runtime.support.film import Film, NetworkStream, Picture, without_password

WAITED_NS = 3 * NS_PER_MS  # a picture that arrives sooner was queued, and newer pictures may follow
QUEUE_MAX = 8  # maximum number of queued pictures to skip per read
STAMP_AGE_NS = NS_PER_S  # timestamps older than this, or in the future, are ignored
STREAMS = ("rtsp", "rtsps", "http", "https")  # FFmpeg's other protocols may open files or listen on ports


class UsbCameraDriver(Sensor):
    """Driver that delivers a camera's newest picture. A webcam picture's capture time is the kernel's
    timestamp for the end of the exposure. Other pictures get their arrival time.
    """

    name = "usb-camera"
    capabilities = Capabilities(colour=True)

    def __init__(self, settings: SensorSettings, clock: Clock) -> None:
        """Store the settings. `source` is a video device's number or path, a file, a URL, or the first camera. Raises
        InputError for a protocol that is not in `STREAMS`, or without a field of view, which webcams do not report.
        """
        if not settings.fov_deg:
            raise InputError("sensor", "fov_deg", "must be set to the camera's horizontal field of view in degrees")
        source = settings.source if settings.source != "demo" else ""
        protocol = re.match(r"([\w+.-]+):", source)
        if protocol is not None and protocol[1] not in STREAMS:
            raise InputError("sensor", "source", f"{protocol[1]} is not supported; use one of {', '.join(STREAMS)}")
        self._source = f"/dev/video{source or 0}" if re.fullmatch(r"\d*", source) else source
        self._fov_rad, self._clock = radians(settings.fov_deg), clock
        self._capture: Any = None
        self._film: Film | None = None
        self._pictures: Iterator[Picture] = iter(())
        self._number = 0

    @property
    def _is_device(self) -> bool:
        return self._source.startswith("/dev/")

    def open(self) -> None:
        self.close()
        if self._is_device and not Path(self._source).exists():
            raise SensorLost(f"{self._source}: camera not found; connect the camera or correct sensor.source")
        if not self._is_device:
            is_stream = "://" in self._source
            try:
                self._film = NetworkStream(self._source) if is_stream else Film(Path(self._source))
            except InputError as error:
                raise SensorLost(f"{self._source} cannot be opened: {error.problem}") from None
            pictures = self._film.pictures()
            if (first := next(pictures, None)) is None:  # connects, so that a refusal is known here
                raise SensorLost(f"{without_password(self._source)} sends no pictures that can be decoded")
            self._pictures = chain([first], pictures)
            return
        capture = cv2.VideoCapture(self._source, cv2.CAP_V4L2)
        if not capture.isOpened():
            capture.release()
            raise SensorLost(
                f"{self._source} cannot be opened; close other programs that use the camera, or add this user to the "
                "group video"
            )
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        self._capture = capture

    def read_newest(self, timeout_s: float) -> SensorFrame:
        if self._film is not None:
            decoded = next(self._pictures, None)
            if decoded is None:
                raise SensorLost(f"{without_password(self._source)} stopped delivering pictures")
            self._number += 1
            return self._frame(self._film.rgb(decoded[1][:1]), self._clock.now_ns())
        if self._capture is None:
            raise SensorLost(f"{without_password(self._source)} is not open")
        for _ in range(QUEUE_MAX):
            begin_ns = self._clock.now_ns()
            if not self._capture.grab():  # waits for the next picture; the worker handles a hang
                raise SensorLost(f"{self._source} stopped delivering pictures")
            self._number += 1
            now_ns = self._clock.now_ns()
            if now_ns - begin_ns > WAITED_NS:
                break
            self.skipped += 1
        done, bgr = self._capture.retrieve()
        if not done:
            raise SensorLost(f"{self._source} sent a picture that cannot be decoded")
        stamp_ns = round(self._capture.get(cv2.CAP_PROP_POS_MSEC) * NS_PER_MS)
        is_stamp = 0 <= now_ns - stamp_ns < STAMP_AGE_NS
        return self._frame(np.ascontiguousarray(bgr[..., ::-1]), stamp_ns if is_stamp else now_ns)

    def _frame(self, rgb: U8, capture_ns: int) -> SensorFrame:
        height, width = rgb.shape[:2]
        intrinsics = Intrinsics.centred(width, height, fov_rad=self._fov_rad)
        return SensorFrame(self._number, capture_ns, colour=rgb, intrinsics=intrinsics)

    def close(self) -> None:
        if self._film is not None:
            self._film.close()
            self._film = None
        if self._capture is not None:
            self._capture.release()
            self._capture = None
