"""Link between the loop and the live pages, which send eye positions and receive layers."""

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

SAMPLES_MAX = 256  # samples waiting for the sensor
CAPTURES_MAX = 512  # captures whose page time is remembered
OVERLAY_PX = 320  # width of the camera picture sent to pages


@dataclass(frozen=True, slots=True)
class SeenEyes:
    """Eye positions that a page reports."""

    eyes_m: F64 | None  # (2, 3), frame `stack`; None: no viewer
    page_ms: float  # time on the page's clock


@dataclass(eq=False)
class BrowserLink:
    """Thread-safe link to the pages. One page is the viewer; the others only watch."""

    stack: PanelStack  # the stack that is shown now
    fov_deg: float
    is_sensor: bool = True  # True: the viewer's eyes come from the page; False: from a camera
    noise_mm: float = 0.2  # standard deviation per axis of the simulated sensor
    latency_ms: float = 0.0
    is_camera: bool = False  # the viewer's page sends its camera's pictures
    camera_fov_deg: float = 65.0  # horizontal; 65 fits most webcams
    wishes: dict[str, float] = field(default_factory=dict)  # choices that need a restart: gap_mm, camera
    moment: Any = None  # newest measured moment: layers and targets
    found: dict[str, Any] | None = None  # newest camera picture and the pupils in it
    frame: PanelFrame | None = None  # newest frame handed to the panels
    shown: tuple[PanelFrame | None, dict[str, Any]] = (None, {})  # frame of the newest refresh, and its record
    news: dict[object, Callable[[], None]] = field(default_factory=dict)  # callback for each refresh, by page
    _arrived: threading.Condition = field(default_factory=threading.Condition)
    _picture: tuple[bytes, float] | None = None  # coded camera picture and its time on the page's clock
    _samples: deque[SeenEyes] = field(default_factory=lambda: deque(maxlen=SAMPLES_MAX))
    _captures: deque[tuple[int, float]] = field(default_factory=lambda: deque(maxlen=CAPTURES_MAX))

    def is_viewer(self, page: object) -> bool:
        """Return True if this page is the viewer, that is, the one that has been connected longest."""
        return next(iter(self.news), None) is page

    def see(self, eyes_m: Any, page_ms: float) -> None:
        """Add a sample. Raises ValueError unless these are two eyes in front of the panels."""
        eyes = None
        if eyes_m is not None:
            eyes = np.array(eyes_m, np.float64)
            if eyes.shape != (2, 3) or not np.isfinite(eyes).all() or eyes[:, 0].min() <= self.stack.x_m[-1]:
                raise ValueError("eyes: must be two points in front of the front panel, in metres")
        with self._arrived:
            self._samples.append(SeenEyes(eyes, float(page_ms)))
            self._arrived.notify()

    def seen(self, timeout_s: float) -> list[SeenEyes]:
        """Take the unread samples, oldest first, waiting for the first one."""
        with self._arrived:
            if not self._samples:
                self._arrived.wait(timeout_s)
            samples = list(self._samples)
            self._samples.clear()
        return samples

    def send_picture(self, coded: bytes, page_ms: float) -> None:
        """Store the newest camera picture, dropping an unread one."""
        with self._arrived:
            self._picture = coded, page_ms
            self._arrived.notify()

    def picture(self, timeout_s: float) -> tuple[bytes, float] | None:
        """Take the newest unread picture, waiting for one."""
        with self._arrived:
            if self._picture is None:
                self._arrived.wait(timeout_s)
            taken, self._picture = self._picture, None
        return taken

    def reporting(self, finder: Any) -> Callable[[SensorFrame], EyePoints | None]:
        """Wrap an eye finder for a page's camera, so that its results are also sent to the pages."""

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
        """Remember the page's time for a capture."""
        self._captures.append((capture_ns, page_ms))

    def page_ms_of(self, capture_ns: int) -> float | None:
        """Return the page time of the newest sample captured by `capture_ns`."""
        return next((page_ms for ns, page_ms in reversed(tuple(self._captures)) if ns <= capture_ns), None)

    def refreshed(self, account: dict[str, Any]) -> None:
        """Publish a refresh. frame: what the panels show; account: its figures, as far as they are known."""
        self.shown = self.frame, account
        self._notify()

    def _notify(self) -> None:
        for notify in tuple(self.news.values()):
            notify()
