"""Link between the loop and live pages, which send eye positions and receive layers."""

from __future__ import annotations

import base64
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np

from runtime.optics.stack import PanelStack
from runtime.records import F64, EyePoints, PanelFrame, SensorFrame

SAMPLES_MAX = 256  # maximum number of samples that wait for the sensor
CAPTURES_MAX = 512  # number of captures whose page time is remembered
OVERLAY_PX = 320  # width of camera pictures sent to pages


@dataclass(frozen=True, slots=True)
class SeenEyes:
    """Eye positions reported by a page."""

    eyes_m: F64 | None  # (2, 3) in the stack frame; None without a viewer
    page_ms: float  # on the page's clock


@dataclass(eq=False)
class BrowserLink:
    """Thread-safe link to the pages. One page is the viewer, and the others only watch."""

    stack: PanelStack  # stack that is currently shown
    fov_deg: float
    is_sensor: bool = True  # True if the eyes come from the page, False if from a camera
    noise_mm: float = 0.2  # simulated noise of the sensor, standard deviation per axis
    latency_ms: float = 0.0
    is_camera: bool = False  # the page of the viewer sends camera pictures
    camera_fov_deg: float = 65.0  # horizontal field of view; 65 degrees is typical for webcams
    wishes: dict[str, float] = field(default_factory=dict)  # choices that require a restart: gap_mm, camera
    moment: Any = None  # layers and targets of the newest measured refresh
    found: dict[str, Any] | None = None  # newest camera picture, with the pupils found in it
    frame: PanelFrame | None = None  # newest frame given to the panels
    shown: tuple[PanelFrame | None, dict[str, Any]] = (None, {})  # frame and record of the newest refresh
    news: dict[object, Callable[[], None]] = field(default_factory=dict)  # called at each refresh, by page
    _arrived: threading.Condition = field(default_factory=threading.Condition)
    _picture: tuple[bytes, float] | None = None  # encoded camera picture, and its time on the page's clock
    _samples: deque[SeenEyes] = field(default_factory=lambda: deque(maxlen=SAMPLES_MAX))
    _captures: deque[tuple[int, float]] = field(default_factory=lambda: deque(maxlen=CAPTURES_MAX))

    def is_viewer(self, page: object) -> bool:
        """True if this page is the viewer, that is, has been connected longest."""
        return next(iter(self.news), None) is page

    def see(self, eyes_m: Any, page_ms: float) -> None:
        """Add a sample. Raises ValueError unless it consists of two eyes in front of the panels."""
        eyes = None
        if eyes_m is not None:
            eyes = np.array(eyes_m, np.float64)
            if eyes.shape != (2, 3) or not np.isfinite(eyes).all() or eyes[:, 0].min() <= self.stack.x_m[-1]:
                raise ValueError("eyes: must be two points in metres that are in front of the front panel")
        with self._arrived:
            self._samples.append(SeenEyes(eyes, float(page_ms)))
            self._arrived.notify()

    def seen(self, timeout_s: float) -> list[SeenEyes]:
        """Take the unread samples, oldest first. Waits for the first one."""
        with self._arrived:
            if not self._samples:
                self._arrived.wait(timeout_s)
            samples = list(self._samples)
            self._samples.clear()
        return samples

    def send_picture(self, coded: bytes, page_ms: float) -> None:
        """Store the newest camera picture. An unread one is dropped."""
        with self._arrived:
            self._picture = coded, page_ms
            self._arrived.notify()

    def picture(self, timeout_s: float) -> tuple[bytes, float] | None:
        """Take the newest unread picture. Waits for one."""
        with self._arrived:
            if self._picture is None:
                self._arrived.wait(timeout_s)
            taken, self._picture = self._picture, None
        return taken

    def reporting(self, finder: Any) -> Callable[[SensorFrame], EyePoints | None]:
        """Wrap an eye finder for the page's camera so that the pages also receive its results."""

        def find(frame: SensorFrame) -> EyePoints | None:
            eyes: EyePoints | None = finder.find(frame)
            if frame.colour is not None and self.news:
                height, width = frame.colour.shape[:2]
                size = (OVERLAY_PX, round(OVERLAY_PX * height / width))
                small: Any = cv2.resize(frame.colour[..., ::-1], size, interpolation=cv2.INTER_AREA)
                coded = base64.b64encode(cv2.imencode(".jpg", small)[1].tobytes()).decode()
                pupils = finder.pupils
                pupils_px = None if pupils is None else np.asarray(pupils.eyes_px) * (OVERLAY_PX / width)
                self.found = {"url": f"data:image/jpeg;base64,{coded}", "size": size, "pupils_px": pupils_px,
                              "reason": finder.reason}  # fmt: skip
                self._notify()
            return eyes

        return find

    def captured(self, capture_ns: int, page_ms: float) -> None:
        """Remember the time of a capture on the page's clock."""
        self._captures.append((capture_ns, page_ms))

    def page_ms_of(self, capture_ns: int) -> float | None:
        """Return the page's time for the newest sample captured no later than `capture_ns`."""
        return next((page_ms for ns, page_ms in reversed(tuple(self._captures)) if ns <= capture_ns), None)

    def refreshed(self, account: dict[str, Any]) -> None:
        """Publish a refresh of the newest frame. account: the status that pages show."""
        self.shown = self.frame, account
        self._notify()

    def _notify(self) -> None:
        for notify in tuple(self.news.values()):
            notify()
