"""Exchange eye positions, camera pictures and layers between the refresh loop and live pages."""

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
CAPTURES_MAX = 512  # number of captures whose time on the page's clock is stored
OVERLAY_PX = 320  # width of camera pictures that are sent to pages


@dataclass(frozen=True, slots=True)
class SeenEyes:
    """Sample of eye positions that a page has sent."""

    eyes_m: F64 | None  # (2, 3) eyes in frame `stack`; None if there is no viewer
    page_ms: float  # time of the sample on the page's clock


@dataclass(eq=False)
class BrowserLink:
    """Passes data between the refresh loop and the pages that show the display.

    The page that has been connected longest is the viewer, whose samples or camera pictures are used. All other pages
    only watch. The link is thread-safe.
    """

    stack: PanelStack  # stack that is shown at present
    fov_deg: float  # horizontal field of view of target pictures
    is_sensor: bool = True  # True if the viewer's page sends eye positions, False if a camera measures the eyes
    noise_mm: float = 0.2  # standard deviation per axis of the simulated noise of the sensor
    latency_ms: float = 0.0  # simulated latency of the sensor
    is_camera: bool = False  # True if the viewer's page sends camera pictures
    camera_fov_deg: float = 65.0  # horizontal field of view of the page's camera; 65 degrees is typical for webcams
    wishes: dict[str, float] = field(default_factory=dict)  # requested changes that require a restart: gap_mm, camera
    moment: Any = None  # layers and target pictures of the newest measured refresh
    found: dict[str, Any] | None = None  # newest camera picture, with the pupils that were found in the picture
    frame: PanelFrame | None = None  # newest frame that was given to the panels
    shown: tuple[PanelFrame | None, dict[str, Any]] = (None, {})  # frame and status of the newest refresh
    news: dict[object, Callable[[], None]] = field(default_factory=dict)  # functions to call when data changes, by page
    _arrived: threading.Condition = field(default_factory=threading.Condition)
    _picture: tuple[bytes, float] | None = None  # encoded camera picture, and its time on the page's clock
    _samples: deque[SeenEyes] = field(default_factory=lambda: deque(maxlen=SAMPLES_MAX))
    _captures: deque[tuple[int, float]] = field(default_factory=lambda: deque(maxlen=CAPTURES_MAX))

    def is_viewer(self, page: object) -> bool:
        """Return True if `page` is the viewer's page, which has been connected longest."""
        return next(iter(self.news), None) is page

    def see(self, eyes_m: Any, page_ms: float) -> None:
        """Add a sample of eye positions.

        Args:
            eyes_m: (2, 3) eyes in frame `stack`, or None if there is no viewer.
            page_ms: Time of the sample on the page's clock.

        Raises:
            ValueError: The sample does not consist of two eyes in front of the front panel.
        """
        eyes = None
        if eyes_m is not None:
            eyes = np.array(eyes_m, np.float64)
            if eyes.shape != (2, 3) or not np.isfinite(eyes).all() or eyes[:, 0].min() <= self.stack.x_m[-1]:
                raise ValueError("eyes: must be two points in front of the front panel, in metres")
        with self._arrived:
            self._samples.append(SeenEyes(eyes, float(page_ms)))
            self._arrived.notify()

    def seen(self, timeout_s: float) -> list[SeenEyes]:
        """Remove the unread samples from the queue and return them, oldest first.

        If there are no unread samples, wait for a sample.

        Args:
            timeout_s: Longest time to wait in seconds. The result is empty if no sample arrives.
        """
        with self._arrived:
            if not self._samples:
                self._arrived.wait(timeout_s)
            samples = list(self._samples)
            self._samples.clear()
        return samples

    def send_picture(self, coded: bytes, page_ms: float) -> None:
        """Store a camera picture in place of the previous picture, even if the previous picture is unread.

        Args:
            coded: Encoded picture.
            page_ms: Time of the picture on the page's clock.
        """
        with self._arrived:
            self._picture = coded, page_ms
            self._arrived.notify()

    def picture(self, timeout_s: float) -> tuple[bytes, float] | None:
        """Remove and return the newest unread camera picture and its time on the page's clock.

        If there is no unread picture, wait for a picture.

        Args:
            timeout_s: Longest time to wait in seconds. The result is None if no picture arrives.
        """
        with self._arrived:
            if self._picture is None:
                self._arrived.wait(timeout_s)
            taken, self._picture = self._picture, None
        return taken

    def reporting(self, finder: Any) -> Callable[[SensorFrame], EyePoints | None]:
        """Wrap an eye finder in a function that also sends its results to the pages.

        Args:
            finder: Eye finder for the pictures of a page's camera.
        """

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
        """Store the time of a capture on the page's clock."""
        self._captures.append((capture_ns, page_ms))

    def page_ms_of(self, capture_ns: int) -> float | None:
        """Return the page time of the newest sample captured no later than `capture_ns`.

        The time is on the page's clock. The result is None if no such sample is stored.
        """
        return next((page_ms for ns, page_ms in reversed(tuple(self._captures)) if ns <= capture_ns), None)

    def refreshed(self, account: dict[str, Any]) -> None:
        """Publish a refresh of the newest frame to the pages.

        Args:
            account: Status of the refresh, which pages show.
        """
        self.shown = self.frame, account
        self._notify()

    def _notify(self) -> None:
        for notify in tuple(self.news.values()):
            notify()
