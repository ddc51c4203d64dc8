"""Pictures, picture folders and videos on the screen's plane: side by side, top-bottom, quilt."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from runtime.clock import NS_PER_S
from runtime.config import ContentSettings
from runtime.content.base import ContentInfo, ContentSource, View
from runtime.content.images import WarpedPicture, plane_from_pixels, rgba_from_rgb
from runtime.content.placing import SceneFile
from runtime.errors import ContentFailure, InputError
from runtime.optics.stack import PanelStack, PlaneRaster
from runtime.records import U8
from runtime.support import progress
from runtime.support.artifacts import read_image
from runtime.support.film import VIDEOS, open_film
from runtime.support.picture_header import check_size, size_of_file

PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
QUILT = re.compile(r"qs([0-9]{1,6})x([0-9]{1,6})(?:a([0-9]+(?:\.[0-9]+)?))?(?![0-9])")
ASPECT_MIN, ASPECT_MAX = 0.05, 20.0  # width over height of one view
MARKS = (  # in a file's name, the longer ones first
    ("_rgbd", "rgbd"), ("_hsbs", "half-side-by-side"), ("_half_sbs", "half-side-by-side"),
    ("_htb", "half-top-bottom"), ("_hou", "half-top-bottom"), ("_half_ou", "half-top-bottom"),
    ("_half_tb", "half-top-bottom"), ("_sbs", "side-by-side"), ("_tb", "top-bottom"), ("_ou", "top-bottom"),
)  # fmt: skip
TELL_EVERY = 64  # pictures between two reports of progress
VIDEO_FRAMES_MAX = 1e8  # that a header may claim: five weeks at 30 a second
VIDEO_PROPERTIES = (
    cv2.CAP_PROP_FRAME_COUNT,
    cv2.CAP_PROP_FPS,
    cv2.CAP_PROP_FRAME_WIDTH,
    cv2.CAP_PROP_FRAME_HEIGHT,
)


@dataclass(frozen=True, slots=True)
class Layout:
    """Arrangement of the views in a picture."""

    kind: str  # mono, rgbd, quilt, side-by-side, top-bottom
    columns: int = 1
    rows: int = 1
    half: bool = False  # its views are squeezed to half their width or height
    view_aspect: float = 0.0  # of a quilt's views, width over height; 0: as their pixels have it

    def views(self, picture: U8) -> list[U8]:
        """[left, right], [one], or a quilt's from the leftmost camera to the rightmost.

        Raises ValueError for a picture that is smaller than one pixel a view.
        """
        height, width = picture.shape[:2]
        if not 0 < self.columns <= width or not 0 < self.rows <= height:
            raise ValueError(f"{width} x {height} pixels cannot hold {self.columns} x {self.rows} views")
        wide, high = width // self.columns, height // self.rows
        if self.kind != "quilt":  # an odd pixel in the middle is of neither view
            rows, columns = (0, height - high)[: self.rows], (0, width - wide)[: self.columns]
            return [picture[v : v + high, u : u + wide] for v in rows for u in columns]
        # The first view is at the bottom left, then rightwards, then upwards.
        return [
            picture[height - (row + 1) * high : height - row * high, column * wide : (column + 1) * wide]
            for row in range(self.rows)
            for column in range(self.columns)
        ]

    def pixel_aspect(self, *, width_px: int, height_px: int) -> float:
        """Width over height of a pixel of a view of that size."""
        if self.half:
            return float(self.columns) if self.columns > 1 else 1 / self.rows
        return self.view_aspect * height_px / width_px if self.view_aspect else 1.0


def layout_of(path: Path, settings: ContentSettings) -> Layout:
    """The arrangement of views in a file, by the setting or by a mark in its name. Raises InputError."""
    stem = path.stem.lower()
    named = settings.layout
    if named == "auto":
        marked = [layout for mark, layout in MARKS if stem.endswith(mark) or f"{mark}_" in stem]
        named = stem if QUILT.search(stem) else (*marked, "mono")[0]
    if found := QUILT.search(named):
        columns, rows, aspect = int(found[1]), int(found[2]), float(found[3] or 0)
        if not columns or not rows:
            raise InputError(path, "layout", f"a quilt of {columns} x {rows} views")
        if aspect and not ASPECT_MIN <= aspect <= ASPECT_MAX:
            problem = f"an aspect of {aspect:g}; must be {ASPECT_MIN:g} to {ASPECT_MAX:g}"
            raise InputError(path, "layout", problem)
        return Layout("quilt", columns, rows, view_aspect=aspect)
    kind = named.removeprefix("half-")
    columns, rows = {"side-by-side": (2, 1), "top-bottom": (1, 2)}.get(kind, (1, 1))
    return Layout(kind, columns, rows, half=kind != named)


def screen(stack: PanelStack, *, width_px: int, height_px: int, pixel_aspect: float = 1.0) -> PlaneRaster:
    """A picture's pixel grid on the stack's centre plane, as large as the display allows.

    pixel_aspect: width of a pixel over its height.
    """
    pitch_m = min(stack.width_m / (width_px * pixel_aspect), stack.height_m / height_px)
    return PlaneRaster(
        x_m=0.0,
        left_m=-pitch_m * pixel_aspect * width_px / 2,
        top_m=pitch_m * height_px / 2,
        pitch_u_m=pitch_m * pixel_aspect,
        pitch_v_m=pitch_m,
        width_px=width_px,
        height_px=height_px,
    )


class Frames(ABC):
    """Pictures in time. Constructors raise InputError; later failures are ContentFailure."""

    count: int
    rate_hz: float

    @abstractmethod
    def frame(self, index: int) -> U8:
        """(h, w, 3) RGB. Raises ContentFailure."""

    def close(self) -> None:  # noqa: B027 - most hold nothing
        """Release files."""


class PictureFiles(Frames):
    """One still picture, or a folder's in the order of their names; rotated by their EXIF orientation."""

    def __init__(self, paths: Sequence[Path], *, rate_hz: float) -> None:
        size_of_file(paths[0])  # before it is unpacked
        self._paths, self._held = paths, (0, read_image(paths[0]))
        first_size = self._held[1].shape[1::-1]
        for number, path in enumerate(paths[1:], start=1):
            if number % TELL_EVERY == 0:
                progress.tell(f"{path.parent.name}: pictures", number, len(paths))
            size = size_of_file(path)  # by its header alone: a long sequence opens quickly
            if size != first_size:
                problem = "{} x {} pixels; the folder's first picture has {} x {}".format(*size, *first_size)
                raise InputError(path, "size", problem)
        self.count, self.rate_hz = len(paths), rate_hz

    def frame(self, index: int) -> U8:
        if index != self._held[0]:
            try:
                self._held = index, read_image(self._paths[index])
            except InputError as error:
                raise ContentFailure(str(error)) from None
        return self._held[1]


class Video(Frames):
    """A video file, read by OpenCV as it goes."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._capture = open_film(path)
        if not self._capture.isOpened():
            raise InputError(path, "", "is not a video that can be decoded")
        try:
            count, self.rate_hz, width, height = (float(self._capture.get(key)) for key in VIDEO_PROPERTIES)
            if not (1 <= count <= VIDEO_FRAMES_MAX and 0.1 < self.rate_hz < 1000):
                raise InputError(path, "frames", f"{count:g} at {self.rate_hz:g} Hz cannot be played")
            check_size(round(width), round(height), source=path)
        except BaseException:
            self._capture.release()
            raise
        self.count = int(count)
        self._next = 0
        self._last: U8 = np.empty((0, 0, 3), np.uint8)
        self.frame(0)

    def frame(self, index: int) -> U8:
        if index == self._next - 1 and self._last.size:
            return self._last
        if index < self._next or index > self._next + 60:
            self._capture.set(cv2.CAP_PROP_POS_FRAMES, index)
            self._next = index
        while self._next < index:
            self._capture.grab()
            self._next += 1
        done, bgr = self._capture.read()
        if not done:
            if self._next == 0:
                raise InputError(self._path, "frames", "the first one cannot be decoded")
            self.count = self._next  # containers count more frames than they hold
            raise ContentFailure(f"{self._path}: frame {index} cannot be decoded")
        self._next = index + 1
        self._last = np.ascontiguousarray(bgr[..., ::-1], np.uint8)
        return self._last

    def close(self) -> None:
        self._capture.release()

    def __reduce__(self) -> tuple[type, tuple[Path]]:
        return Video, (self._path,)


def open_frames(path: Path, settings: ContentSettings) -> Frames:
    """A picture, a video, or a folder of pictures. Raises InputError."""
    if path.suffix.lower() in VIDEOS and not path.is_dir():
        return Video(path)
    paths = [path]
    if path.is_dir():
        paths = sorted(item for item in path.iterdir() if item.suffix.lower() in PICTURES)
    if not paths:
        raise InputError(path, "", "the folder holds no pictures")
    return PictureFiles(paths, rate_hz=settings.picture_rate_hz)


def prepare(file: SceneFile) -> Callable[..., ContentSource]:
    """Open a picture, a video or a folder of pictures. Raises InputError."""
    frames = open_frames(file.path, file.settings)
    make = partial(PicturesSource, frames, layout=layout_of(file.path, file.settings), file=file)
    make()  # refuses what is too small
    return make


class PicturesSource(ContentSource):
    """Views of pictures or films that hang in the plane of the display's centre."""

    def __init__(self, frames: Frames, *, layout: Layout, file: SceneFile, context: object = None) -> None:
        """Raises InputError where the picture is too small for its layout."""
        self._frames, self._layout, self._file = frames, layout, file
        first = frames.frame(0)
        try:
            self._take(0, first)
        except ValueError as error:
            raise InputError(file.path, "layout", str(error)) from None
        moving, mono = frames.count > 1, layout.kind == "mono"
        self.info = ContentInfo(
            name=file.path.stem,
            moving=moving,
            grey=not moving and _is_grey(first),
            background=file.background,
            flat_x_m=0.0 if mono else None,
        )

    def render(self, view: View, *, time_ns: int) -> U8:
        number = self.revision(time_ns=time_ns)
        if number != self._at:
            try:
                self._take(number, self._frames.frame(number))
            except ValueError as error:
                raise ContentFailure(f"{self.info.name}: {error}") from None
        which = self._view_for(view)
        if which not in self._shown:
            self._shown[which] = WarpedPicture(rgba_from_rgb(self._views[which]), background=self._file.background)
        matrix = plane_from_pixels(view.pixels_from_stack, self._screen)
        return self._shown[which].warped(matrix, view)

    def _take(self, number: int, picture: U8) -> None:
        """Raises ValueError where it is too small."""
        views = self._layout.views(picture)
        height, width = views[0].shape[:2]
        aspect = self._layout.pixel_aspect(width_px=width, height_px=height)
        self._screen = screen(self._file.stack, width_px=width, height_px=height, pixel_aspect=aspect)
        self._shown: dict[int, WarpedPicture] = {}
        self._views, self._at = views, number  # of the picture of this number

    def _view_for(self, view: View) -> int:
        """Which of the pictures an eye gets: its side's, or a quilt's nearest in angle about the vertical."""
        if len(self._views) <= 2:
            return min(view.side, len(self._views) - 1)
        angle = np.arctan2(view.eye_m[1], view.eye_m[0])
        place = (angle / np.radians(self._file.settings.cone_deg) + 0.5) * (len(self._views) - 1)
        return int(np.clip(np.rint(place), 0, len(self._views) - 1))

    def revision(self, *, time_ns: int) -> int:
        return int(time_ns * self._frames.rate_hz / NS_PER_S) % self._frames.count

    def close(self) -> None:
        self._frames.close()


def _is_grey(rgb: U8) -> bool:
    small = rgb[::4, ::4].astype(np.int16)
    return bool((np.ptp(small, axis=2) <= 2).all())
