"""Live pictures, such as those of a video player, with a view for each eye.

A feed's thread keeps the newest picture. The solver never waits for it.
"""

from __future__ import annotations

import os
import signal
import subprocess
import threading
import time
from abc import ABC, abstractmethod
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from runtime.config import ContentSettings
from runtime.content.base import ContentInfo, ContentSource, View
from runtime.content.comfort import DepthLimit
from runtime.content.layout import MONO, Layout, hint, layout_of, of_film
from runtime.content.pictures import ShownViews
from runtime.content.placing import SceneFile
from runtime.errors import ContentFailure
from runtime.records import U8
from runtime.support.background import begin

POINTER = np.array([[0, 0], [0, 0.9], [0.22, 0.7], [0.36, 1], [0.5, 0.94], [0.36, 0.64], [0.64, 0.64]])  # an arrow
POINTER_MIN_PX = 12  # smallest height of the mouse pointer
POINTER_SIZE = 0.03  # height of the mouse pointer, as a fraction of the picture's
FROZEN_S = 2.0  # a feed counts as frozen after this time without a picture
CLOSES_WITHIN_S = 2.0
ENDS_WITHIN_S = 1.0  # time limit for a feed's process to end by itself
LOOKED_AT_EVERY = 30  # pictures after which a flat feed is checked again for two views


@dataclass(frozen=True, slots=True)
class LivePicture:
    """A picture of a feed."""

    number: int  # increases with each picture
    rgb: U8  # (h, w, 3), with every view in the layout
    pixel_aspect: float = 1.0  # pixel width divided by pixel height
    pointer: tuple[float, float] | None = None  # place of a mouse pointer to draw, as fractions of width and height


class Feed(ABC):
    """Thread that reads pictures from outside and keeps the newest one."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.newest: LivePicture | None = None
        self.problem = f"waiting for {name}"  # one line; empty while pictures arrive
        self._ends = threading.Event()
        self._count, self._seen_s = 0, 0.0  # `_seen_s`: when the source was last seen to work
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Start reading."""
        self._thread = begin(f"feed {self.name}", self._run)

    def close(self) -> None:
        """Stop reading, and wait a short time for the thread to end."""
        self._ends.set()
        if self._thread is not None:
            self._thread.join(CLOSES_WITHIN_S)

    @abstractmethod
    def _run(self) -> None:
        """Read pictures and call `_take` for each, until `_ends` is set."""

    def _take(
        self, rgb: U8, pixel_aspect: float = 1.0, pointer: tuple[float, float] | None = None, problem: str = ""
    ) -> None:
        self._count += 1
        self._seen_s = time.monotonic()
        self.newest = LivePicture(self._count, rgb, pixel_aspect, pointer)
        self.problem = problem

    def state(self) -> str:
        """Return why no new pictures arrive, in one line, or an empty string."""
        if self.problem:
            return self.problem
        still_s = time.monotonic() - self._seen_s
        return f"{self.name}: no new picture for {still_s:.0f} s" if still_s > FROZEN_S else ""


class LiveSource(ContentSource):
    """Source that shows a feed's newest picture on the plane through the display's centre."""

    def __init__(self, feed: Feed, *, file: SceneFile, context: object = None) -> None:
        """Start the feed, which the source owns from now on."""
        self._feed, self._file = feed, file
        self.info = ContentInfo(feed.name, moving=True, background=file.background, fixed_views=True)
        self._at = 0
        self._shown: ShownViews
        self._limit = DepthLimit(follows=True)
        self._layout: tuple[tuple[int, ...], int, Layout] = ((), 0, MONO)  # a picture's shape, number and layout
        feed.start()

    @property
    def problem(self) -> str:
        return self._feed.state()

    def revision(self, *, time_ns: int) -> int:
        newest = self._feed.newest
        return 0 if newest is None else newest.number

    def render(self, view: View, *, time_ns: int) -> U8:
        self.expect([view], time_ns=time_ns)
        picture_from_view = self._shown.within(self._limit, self._at, view)
        return self._shown.warped(min(view.side, len(self._shown.views) - 1), picture_from_view, view)

    def expect(self, views: Any, *, time_ns: int) -> None:
        """Take the newest picture, unless the next view is the same pair's second one."""
        newest = self._feed.newest
        if newest is None:
            raise ContentFailure(self._feed.problem or f"waiting for {self._feed.name}")
        is_second = len(views) == 1 and views[0].side == 1 and self._at
        if newest.number == self._at or is_second:
            return
        layout = self._layout_for(newest)
        try:
            parts = layout.views(newest.rgb)
        except ValueError as error:
            raise ContentFailure(f"{self._feed.name}: {error}") from None
        if newest.pointer is not None:
            parts = with_pointer(parts, layout, newest.pointer)
        self._shown, self._at = ShownViews(parts, layout, self._file), newest.number

    def _layout_for(self, picture: LivePicture) -> Layout:
        """Return the layout that the settings state, or the one that a picture of a new size seems to have."""
        shape, number, layout = self._layout
        is_unsure = layout.kind == "mono" and picture.number >= number + LOOKED_AT_EVERY
        if shape != picture.rgb.shape or (is_unsure and self._file.settings.layout == "auto"):
            layout = layout_for(picture, self._file.settings)
            self._layout = picture.rgb.shape, picture.number, layout
        return layout

    def close(self) -> None:
        self._feed.close()


def end_group(process: subprocess.Popen[bytes]) -> None:
    """End a process that leads a session, and those that it started."""
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGTERM)
    try:
        process.wait(ENDS_WITHIN_S)
    except subprocess.TimeoutExpired:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def with_pointer(views: list[U8], layout: Layout, place: tuple[float, float]) -> list[U8]:
    """Return copies of a picture's views with a mouse pointer at the same place in all, which is the
    screen's depth. `place` is the pointer's in the whole picture, as fractions of its width and height. Views of
    a quilt are returned unchanged.
    """
    if layout.kind == "quilt":
        return views
    height, width = views[0].shape[:2]
    at = np.array([place[0] * layout.columns % 1 * width, place[1] * layout.rows % 1 * height])
    size = max(POINTER_SIZE * height, POINTER_MIN_PX) * np.array(
        [1 / layout.pixel_aspect(width_px=width, height_px=height), 1]
    )
    corners = np.rint(16 * (at + size * POINTER)).astype(np.int32)  # in sixteenths of a pixel
    drawn = [view.copy() for view in views]
    for view in drawn:
        cv2.fillPoly(view, [corners], (255, 255, 255), cv2.LINE_AA, 4)
        cv2.polylines(view, [corners], isClosed=True, color=(0, 0, 0), thickness=1, lineType=cv2.LINE_AA, shift=4)
    return drawn


def layout_for(picture: LivePicture, settings: ContentSettings) -> Layout:
    """Return a live picture's layout, by the settings or, with `auto`, by comparing its halves."""
    layout = settings.layout
    if layout == "auto":
        layout = hint(picture.rgb) or "mono"
    path = Path(settings.scene)
    stated = layout_of(path, settings.model_copy(update={"layout": layout}))
    stated = replace(stated, sample_aspect=picture.pixel_aspect)
    if settings.layout == "auto":
        height, width = picture.rgb.shape[:2]
        stated = of_film(stated, path, width_px=round(width * picture.pixel_aspect), height_px=height)
    return stated
