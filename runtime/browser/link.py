"""Between the loop and the pages that show it: the viewer's eyes go one way, what the panels show the other."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from runtime.optics.stack import PanelStack
from runtime.records import F64, PanelFrame

SAMPLES_MAX = 256  # that wait for the sensor
CAPTURES_MAX = 512  # whose time on the page is remembered


@dataclass(frozen=True, slots=True)
class SeenEyes:
    """Where a page says that its viewer's eyes are."""

    eyes_m: F64 | None  # (2, 3), frame `stack`; None: nobody is before the display
    page_ms: float  # by the page's own clock


@dataclass(eq=False)
class BrowserLink:
    """Any thread may use it. Of several pages one is the viewer; the others look on."""

    stack: PanelStack  # whose panels are shown at present
    fov_deg: float
    is_sensor: bool = True  # the page's eyes are the viewer's; else a camera's are
    noise_mm: float = 0.2  # of the simulated sensor: standard deviation of an axis
    latency_ms: float = 0.0
    gap_wanted_m: float | None = None  # between neighbouring panels, where a page asks for another one
    frame: PanelFrame | None = None  # that the panels were given
    shown: tuple[PanelFrame | None, dict[str, Any]] = (None, {})  # by the newest refresh, and what is known of it
    news: dict[object, Callable[[], None]] = field(default_factory=dict)  # whom to tell of a refresh, by page
    _arrived: threading.Condition = field(default_factory=threading.Condition)
    _samples: deque[SeenEyes] = field(default_factory=lambda: deque(maxlen=SAMPLES_MAX))
    _captures: deque[tuple[int, float]] = field(default_factory=lambda: deque(maxlen=CAPTURES_MAX))

    def is_viewer(self, page: object) -> bool:
        """Whether a page's eyes count: those of the one that is there for longest."""
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

    def captured(self, capture_ns: int, page_ms: float) -> None:
        """Remember which instant of the page a capture is."""
        self._captures.append((capture_ns, page_ms))

    def page_ms_of(self, capture_ns: int) -> float | None:
        """When, by the page's clock, the newest sample was seen that had been captured by then."""
        return next((page_ms for ns, page_ms in reversed(tuple(self._captures)) if ns <= capture_ns), None)

    def refreshed(self, account: dict[str, Any]) -> None:
        """The panels show `frame`, and this is known of it."""
        self.shown = self.frame, account
        for tell in tuple(self.news.values()):
            tell()
