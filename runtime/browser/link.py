"""The link between the loop and the live pages: the viewer's eyes in, the panels' layers out."""

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

SAMPLES_MAX = 256  # that wait for the sensor
CAPTURES_MAX = 512  # whose time on the page is remembered
OVERLAY_PX = 320  # width of the camera's picture that pages are shown


@dataclass(frozen=True, slots=True)
class SeenEyes:
    """Where a page says that its viewer's eyes are."""

    eyes_m: F64 | None  # (2, 3), frame `stack`; None: nobody is before the display
    page_ms: float  # by the page's own clock


@dataclass(eq=False)
class BrowserLink:
    """Thread-safe link to the pages. One page is the viewer; the others look on."""

    stack: PanelStack  # whose panels are shown at present
    fov_deg: float
    is_sensor: bool = True  # the page's eyes are the viewer's; else a camera's are
    noise_mm: float = 0.2  # of the simulated sensor: standard deviation of an axis
    latency_ms: float = 0.0
    is_camera: bool = False  # the viewer's page sends pictures of its own camera
    camera_fov_deg: float = 65.0  # their width; most cameras in or on a screen
    wishes: dict[str, float] = field(default_factory=dict)  # of a page, that need a new start: gap_mm, camera
    moment: Any = None  # the newest that was measured: layers, and what eyes should see of them
    found: dict[str, Any] | None = None  # the newest picture of a camera, and the pupils in it
    frame: PanelFrame | None = None  # that the panels were given
    shown: tuple[PanelFrame | None, dict[str, Any]] = (None, {})  # by the newest refresh, and what is known of it
    news: dict[object, Callable[[], None]] = field(default_factory=dict)  # whom to tell of a refresh, by page
    _arrived: threading.Condition = field(default_factory=threading.Condition)
    _picture: tuple[bytes, float] | None = None  # of the page's camera, and when by the page's clock
    _samples: deque[SeenEyes] = field(default_factory=lambda: deque(maxlen=SAMPLES_MAX))
    _captures: deque[tuple[int, float]] = field(default_factory=lambda: deque(maxlen=CAPTURES_MAX))

    def is_viewer(self, page: object) -> bool:
        """Whether this page is the viewer: the one connected longest."""
        return next(iter(self.news), None) is page

    def see(self, eyes_m: Any, page_ms: float) -> None:
        """Take in a sample. Raises ValueError for what are no eyes before the panels."""
        eyes = None
        if eyes_m is not None:
            eyes = np.array(eyes_m, np.float64)
            if eyes.shape != (2, 3) or not np.isfinite(eyes).all() or eyes[:, 0].min() <= self.stack.x_m[-1]:
                raise ValueError("eyes: two points before the front panel, metres")
        with self._arrived:
            self._samples.append(SeenEyes(eyes, float(page_ms)))
            self._arrived.notify()

    def seen(self, timeout_s: float) -> list[SeenEyes]:
        """The samples that were not taken yet, oldest first; waits for one."""
        with self._arrived:
            if not self._samples:
                self._arrived.wait(timeout_s)
            samples = list(self._samples)
            self._samples.clear()
        return samples

    def send_picture(self, coded: bytes, page_ms: float) -> None:
        """Take in a picture of the page's camera; one that was not looked at yet goes."""
        with self._arrived:
            self._picture = coded, page_ms
            self._arrived.notify()

    def picture(self, timeout_s: float) -> tuple[bytes, float] | None:
        """The newest picture that was not taken yet; waits for one."""
        with self._arrived:
            if self._picture is None:
                self._arrived.wait(timeout_s)
            taken, self._picture = self._picture, None
        return taken

    def looked_at(self, finder: Any) -> Callable[[SensorFrame], EyePoints | None]:
        """An eye finder for a page's camera whose results are also sent to the pages."""

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
                self._tell()
            return eyes

        return find

    def captured(self, capture_ns: int, page_ms: float) -> None:
        """Remember which instant of the page a capture is."""
        self._captures.append((capture_ns, page_ms))

    def page_ms_of(self, capture_ns: int) -> float | None:
        """When, by the page's clock, the newest sample was seen that had been captured by then."""
        return next((page_ms for ns, page_ms in reversed(tuple(self._captures)) if ns <= capture_ns), None)

    def refreshed(self, account: dict[str, Any]) -> None:
        """The panels show `frame`, and this is known of it."""
        self.shown = self.frame, account
        self._tell()

    def _tell(self) -> None:
        for tell in tuple(self.news.values()):
            tell()
