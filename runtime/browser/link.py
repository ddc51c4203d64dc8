"""Exchange eye positions, camera pictures and layers between the refresh loop and all live pages."""

from __future__ import annotations

import base64
import threading
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np

from runtime.optics.stack import PanelStack
from runtime.records import F64, EyePoints, Eyes, PanelFrame, SensorFrame

FASTEST_M_S = 5.0  # maximum speed of a head
PAGES_MAX = 8  # maximum number of live pages, because pictures are sent to each of them
SAMPLES_MAX = 256  # maximum number of samples waiting for the sensor
CAPTURES_MAX = 512  # for how many captures the time on the page's clock is stored
OVERLAY_PX = 320  # width of the camera pictures sent to pages


@dataclass(frozen=True, slots=True)
class SeenEyes:
    """A sample of eye positions sent by a page."""

    eyes_m: Eyes | None  # (2, 3) eyes in the `stack` frame; None without a viewer
    page_ms: float  # the sample's time on the page's clock
    head: int = 0  # whose eyes, see `BrowserLink.head_of`
    velocity_m_s: F64 | None = None  # (3,) of both eyes; None: they rest


@dataclass(frozen=True, slots=True)
class PageMode:
    """Display that pages show, and how they serve as the sensor. Any change restarts the refresh loop."""

    stack: PanelStack
    fov_deg: float  # the target pictures' horizontal field of view
    is_sensor: bool = True  # pages send eye positions; otherwise they are measured with a camera
    is_camera: bool = False  # the page that has been connected longest sends camera pictures
    heads: int = 1  # number of pages whose eyes are used, one head each


@dataclass(frozen=True, slots=True)
class PageSensor:
    """Properties of a page as a sensor, which any page may change at any time."""

    noise_mm: float = 0.2  # simulated noise, standard deviation along each axis
    latency_ms: float = 0.0  # simulated latency
    camera_fov_deg: float = 65.0  # horizontal field of view; 65 degrees is typical of webcams


@dataclass(frozen=True, slots=True)
class Shown:
    """Latest state of the refresh loop, as published to all pages."""

    frame: PanelFrame | None = None  # None before the first refresh of a loop
    told: Mapping[str, Any] = field(default_factory=dict)  # status of the latest refresh
    moment: Any = None  # layers and target pictures from the latest measured refresh


class BrowserLink:
    """Latest values that the refresh loop and all pages that show the display exchange.
    Each is replaced as a whole.
    Thread-safe. The first `PageMode.heads` pages each move a head, until they leave; all other pages just watch. Camera
    pictures are used only from the page that has been connected longest.
    """

    def __init__(self, mode: PageMode) -> None:
        self.mode = mode
        self.sensor = PageSensor()
        self.shown = Shown()
        self.found: Mapping[str, Any] | None = None  # latest camera picture and the pupils found in it
        self.wishes: Mapping[str, float] = {}  # changes requested that need a restart: gap_mm, camera
        self._pages: dict[object, Callable[[], None]] = {}  # called when data changes
        self._heads: list[object | None] = [None] * mode.heads  # page that moves each head
        self._arrived = threading.Condition()
        self._picture: tuple[bytes, float] | None = None  # encoded camera picture and its time on the page's clock
        self._samples: deque[SeenEyes] = deque(maxlen=SAMPLES_MAX)
        self._captures: deque[tuple[int, SeenEyes]] = deque(maxlen=CAPTURES_MAX)

    def join(self, page: object, notify: Callable[[], None]) -> bool:
        """Connect a page, which is notified of changes on any thread.
        Returns False if too many are connected.
        """
        if len(self._pages) >= PAGES_MAX:
            return False
        self._pages[page] = notify
        self._give_heads()
        return True

    def leave(self, page: object) -> None:
        """Disconnect a page, which ends its camera. Its head goes to the page that has watched longest."""
        head, had_camera = self.head_of(page), self.is_camera(page)
        del self._pages[page]
        if head is not None:
            self.see(None, 0.0, head)
            self._heads[head] = None
            self._give_heads()
        if had_camera and self.mode.is_camera:
            self.wish("camera", 0.0)

    def _give_heads(self) -> None:
        watching = (page for page in self._pages if page not in self._heads)
        self._heads = [next(watching, None) if page is None else page for page in self._heads]

    def head_of(self, page: object) -> int | None:
        """Return the number, from 0, of the head that a page moves, or None if it only watches."""
        return self._heads.index(page) if self.mode.is_sensor and page in self._heads else None

    def is_camera(self, page: object) -> bool:
        """Return True if only this page may send camera pictures, because it has been connected longest."""
        return next(iter(self._pages), None) is page

    def wish(self, name: str, value: float) -> None:
        """Ask for a change that restarts the refresh loop."""
        self.wishes = {**self.wishes, name: value}

    def begin_again(self, mode: PageMode) -> None:
        """Forget all wishes and shown pictures, because the refresh loop begins again."""
        self.wishes, self.found, self.shown = {}, None, Shown(told=self.shown.told)
        self.mode = mode

    def see(self, eyes_m: Any, page_ms: float, head: int = 0, velocity_m_s: Any = None) -> None:
        """Add a head's eyes (2, 3) in `stack`, or None. Raises ValueError if they are not in front of
        all panels or too fast.
        """
        eyes = velocity = None
        if velocity_m_s is not None:
            velocity = np.array(velocity_m_s, np.float64)
            if velocity.shape != (3,) or not np.abs(velocity).max() <= FASTEST_M_S:
                raise ValueError(f"velocity: must be three numbers of at most {FASTEST_M_S} m/s")
        if eyes_m is not None:
            eyes = np.array(eyes_m, np.float64)
            if eyes.shape != (2, 3) or not np.isfinite(eyes).all() or eyes[:, 0].min() <= self.mode.stack.x_m[-1]:
                raise ValueError("eyes: must be two points in metres that are in front of the front panel")
        with self._arrived:
            self._samples.append(SeenEyes(eyes, float(page_ms), head, velocity))
            self._arrived.notify()

    def seen(self, timeout_s: float) -> list[SeenEyes]:
        """Take all unread samples, oldest first. Without any, wait for one for at most `timeout_s`."""
        with self._arrived:
            if not self._samples:
                self._arrived.wait(timeout_s)
            samples = list(self._samples)
            self._samples.clear()
        return samples

    def send_picture(self, coded: bytes, page_ms: float) -> None:
        """Store an encoded camera picture in place of the previous one, even if that one has not been read."""
        with self._arrived:
            self._picture = coded, page_ms
            self._arrived.notify()

    def picture(self, timeout_s: float) -> tuple[bytes, float] | None:
        """Take the unread camera picture and its `page_ms`, or None if none arrives within `timeout_s`."""
        with self._arrived:
            if self._picture is None:
                self._arrived.wait(timeout_s)
            taken, self._picture = self._picture, None
        return taken

    def report(self, found: Mapping[str, Any]) -> None:
        """Show all pages a camera picture and the pupils found in it (`Reporting.found`)."""
        self.found = found
        self._notify()

    def captured(self, capture_ns: int, sample: SeenEyes) -> None:
        """Store a sample's capture time."""
        self._captures.append((capture_ns, sample))

    def page_ms_of(self, capture_ns: int, head: int) -> float | None:
        """Return the page's time of a head's latest sample captured at or before `capture_ns`, or None."""
        captures = reversed(tuple(self._captures))
        return next((one.page_ms for ns, one in captures if ns <= capture_ns and one.head == head), None)

    def show(self, frame: PanelFrame, told: Mapping[str, Any], *, moment: Any) -> None:
        """Publish the latest frame, its refresh's status and the latest measured refresh to all pages."""
        self.shown = Shown(frame, told, moment)
        self._notify()

    def _notify(self) -> None:
        for notify in tuple(self._pages.values()):
            notify()


class Reporting:
    """An eye finder that also keeps the last picture, with the pupils, for pages to show."""

    def __init__(self, make_finder: Callable[[], Any]) -> None:
        self._finder = make_finder()
        self.found: dict[str, Any] | None = None

    def find_all(self, frame: SensorFrame) -> tuple[EyePoints, ...]:
        eyes: tuple[EyePoints, ...] = self._finder.find_all(frame)
        if frame.colour is not None:
            height, width = frame.colour.shape[:2]
            size = (OVERLAY_PX, round(OVERLAY_PX * height / width))
            small: Any = cv2.resize(frame.colour[..., ::-1], size, interpolation=cv2.INTER_AREA)
            coded = base64.b64encode(cv2.imencode(".jpg", small)[1].tobytes()).decode()
            pupils = self._finder.pupils
            pupils_px = None if pupils is None else np.asarray(pupils.eyes_px) * (OVERLAY_PX / width)
            self.found = {"url": f"data:image/jpeg;base64,{coded}", "size": size, "pupils_px": pupils_px,
                          "reason": self._finder.reason}  # fmt: skip
        return eyes
