"""Open stills, animations, picture folders and films as sequences of pictures with layouts."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.clock import NS_PER_MS, NS_PER_S
from runtime.config import ContentSettings
from runtime.content.layout import MONO, PAIR, Layout, hint, layout_of, of_film
from runtime.content.placing import DARK
from runtime.errors import ContentFailure, InputError
from runtime.records import U8
from runtime.support import progress
from runtime.support.picture_file import read_animation, read_views
from runtime.support.picture_header import RAW, VIDEOS, Header, camera_set_in, check_size, header_of_file

if TYPE_CHECKING:
    from runtime.support.film import Film, Picture

log = logging.getLogger("phasestack.content")

PICTURES = (
    ".png", ".jpg", ".jpeg", ".jfif", ".mpo", ".jps", ".pns", ".bmp", ".tif", ".tiff", ".webp", ".gif", ".apng",
    ".avif", ".heic", ".heif", ".hif", ".ppm", ".pgm", ".tga",
)  # fmt: skip
NOT_READ = (*RAW, ".jxl", ".exr", ".hdr", ".psd", ".svg", ".jp2", *VIDEOS)  # skipped and logged if found in a folder
TOLD = 3  # number of skipped files per folder that are named in the log
TELL_EVERY = 64  # number of pictures between progress reports
AROUND = (
    "shows all directions (equirectangular), which is not supported; crop it, for example with "
    "`ffmpeg -i in -vf v360=e:flat:h_fov=75:v_fov=46 out`"
)
SKIPPED = 60  # most frames that are decoded in passing instead of seeking


class Frames(ABC):
    """Sequence of pictures played in a loop. Constructors raise InputError if they cannot be shown."""

    count: int  # number of pictures
    rate_hz: float  # pictures per second
    layouts: Sequence[Layout]  # layout of each picture, or a single layout for all pictures

    @abstractmethod
    def frame(self, index: int) -> U8:
        """Return the frame at `index`, with every view in the layout, RGB (h, w, 3). Raises ContentFailure."""

    def layout(self, index: int) -> Layout:
        return self.layouts[min(index, len(self.layouts) - 1)]

    def at(self, time_ns: int) -> int:
        """Return the index of the picture shown at a given time."""
        return int(time_ns * self.rate_hz / NS_PER_S) % self.count

    def close(self) -> None:  # noqa: B027 - most sequences hold no files open
        """Close any open files."""


class PictureFiles(Frames):
    """Sequence of still pictures, one per file. If two views are shown, they are joined side by side."""

    def __init__(self, paths: Sequence[Path], settings: ContentSettings, *, folder: Path | None = None) -> None:
        """Read the headers of all pictures in order, and decode the first picture that can be decoded. Without
        `folder`, there is a single file. In a folder, films, unreadable headers and faulty pictures at the start are
        skipped and logged. Raises InputError if no file can be used.
        """
        self._background = settings.background or DARK
        self.layouts, self._paths, refused = [], [], []
        for number, path in enumerate(paths):
            if number % TELL_EVERY == 0:
                progress.tell(f"{path.parent.name}: pictures", number, len(paths))
            try:
                if folder is not None and path.suffix.lower() in VIDEOS:
                    raise InputError(path, "", "is a film; set content.scene to the film itself")
                # Only the header, because decoding every picture would take too long.
                layout = layout_in(header_of_file(path), path, settings, folder)
            except InputError as error:
                refused.append(error)
                continue
            self.layouts.append(layout)
            self._paths.append(path)
        self._held = -1, np.empty((0, 0, 3), np.uint8)
        while self._paths and self._held[0] < 0:
            try:
                self._held = 0, self._read(0)
            except InputError as error:  # only its header was intact
                refused.append(error)
                del self._paths[0], self.layouts[0]
        if not self._paths:
            raise refused[0]
        if refused:
            some = "; ".join(f"{Path(error.source).name} {error.problem}" for error in refused[:TOLD])
            log.warning("%s: skipping %d of %d pictures: %s", folder, len(refused), len(paths), some)
        self.count, self.rate_hz = len(self._paths), settings.picture_rate_hz
        if folder is None and self.layouts == [MONO] and settings.layout == "auto":
            _suggest(paths[0], self._held[1])

    def frame(self, index: int) -> U8:
        if index != self._held[0]:
            try:
                self._held = index, self._read(index)
            except InputError as error:
                raise ContentFailure(str(error)) from None
        return self._held[1]

    def _read(self, index: int) -> U8:
        views = read_views(self._paths[index], background=self._background)
        is_pair = len(views) == 2 and self.layouts[index].kind != "mono"
        return np.concatenate(views, axis=1) if is_pair else views[0]


class Animation(Frames):
    """The frames of an animated picture, all decoded at the start."""

    def __init__(self, path: Path, settings: ContentSettings) -> None:
        self.layouts = [layout_of(path, settings)]
        self._frames, shown_ms = read_animation(path, background=settings.background or DARK)
        self.count = len(self._frames)
        self._ends_ns = list(accumulate(round(ms * NS_PER_MS) for ms in shown_ms))
        self.rate_hz = self.count * NS_PER_S / self._ends_ns[-1]

    def frame(self, index: int) -> U8:
        return self._frames[index]

    def at(self, time_ns: int) -> int:
        return bisect_right(self._ends_ns, time_ns % self._ends_ns[-1])


class Video(Frames):
    """The frames of a film, decoded during playback and each shown at its own time."""

    def __init__(self, path: Path, settings: ContentSettings, times_ns: NDArray[np.int64] | None = None) -> None:
        """Open a film, with its frames' times if known, and decode its first frame. Raises InputError."""
        from runtime.support.film import Film  # noqa: PLC0415 - PyAV is in an extra

        self._film, self._settings = Film(path, times_ns=times_ns), settings
        self._background = settings.background or DARK
        self.count = len(self._film.times_ns) - 1
        self._pictures: Iterator[Picture] = iter(())
        self._index, self._shown_ns, self._last = self.count, -NS_PER_S, np.empty((0, 0, 3), np.uint8)
        self.layouts = [_film_layout(self._film, settings, self.frame(0))]

    def at(self, time_ns: int) -> int:
        times_ns = self._film.times_ns[: self.count + 1]
        return int(np.searchsorted(times_ns, time_ns % int(times_ns[-1]), side="right")) - 1

    def frame(self, index: int) -> U8:
        film, wanted_ns = self._film, int(self._film.times_ns[index])
        if index < self._index or index > self._index + SKIPPED:
            self._pictures, self._shown_ns = film.pictures(wanted_ns), -NS_PER_S
        self._index = index
        if self._shown_ns > wanted_ns - NS_PER_MS:  # Matroska rounds times to milliseconds
            return self._last
        for time_ns, frames in self._pictures:
            if time_ns > wanted_ns - NS_PER_MS:
                check_size(frames[0].width, frames[0].height, source=film.path)
                views = frames[:1] if self._settings.layout == "mono" else frames
                self._last, self._shown_ns = film.rgb(views, background=self._background), time_ns
                return self._last
        self.count = max(index, 1)  # the file is cut off
        raise ContentFailure(f"{film.path}: frame {index} cannot be decoded")

    def close(self) -> None:
        self._film.close()

    def __reduce__(self) -> tuple[type, tuple[Any, ...]]:
        return Video, (self._film.path, self._settings, self._film.times_ns)


def layout_in(header: Header, path: Path, settings: ContentSettings, folder: Path | None = None) -> Layout:
    """Return a picture's layout, from the settings, the header, or the name of the file or of `folder`.
    Two views in a file are side by side, unless the settings request a single view or the cross-eyed order. Raises
    InputError for a picture all around, or a layout that is not possible.
    """
    if header.is_around:
        raise InputError(path, "", AROUND)
    layout = layout_of(path, settings, stated=header.layout)
    if len(header.views) == 1:
        return layout if layout != MONO or folder is None else layout_of(folder, settings)
    if settings.layout == "mono" or (layout.right_first and settings.layout != "auto"):
        return layout
    return PAIR


def open_frames(path: Path, settings: ContentSettings) -> Frames:
    """Open a picture, an animation, a video or a folder of pictures. Raises InputError."""
    if not path.is_dir():
        if path.suffix.lower() in VIDEOS:
            return Video(path, settings)
        return Animation(path, settings) if header_of_file(path).is_animated else PictureFiles([path], settings)
    paths = sorted(item for item in path.iterdir() if item.suffix.lower() in (*PICTURES, *NOT_READ))
    if not paths:
        raise InputError(path, "", _why_none(path))
    return PictureFiles(paths, settings, folder=path)


def _suggest(path: Path, picture: U8) -> None:
    """Log a hint if a picture shown as a single view probably contains several."""
    if "quilt" in path.stem.lower():
        log.warning("%s: if this picture is a quilt, pass --layout qs8x6a0.75 (columns, rows, view aspect)", path)
    elif found := hint(picture):
        log.warning("%s: the halves are almost the same; if they are two views, pass --layout %s", path, found)


def _film_layout(film: Film, settings: ContentSettings, picture: U8) -> Layout:
    """Return the layout of a film whose first picture is given. Logs views that are not shown.
    Raises InputError for a film all around.
    """
    stated, path = film.header, film.path
    if stated.is_around:
        raise InputError(path, "", AROUND)
    if stated.left_out and settings.layout == "auto":
        log.warning("%s: showing the film without %s", path, stated.left_out)
    layout = layout_of(path, settings, stated=stated.layout)
    if is_pair := stated.views == 2 and settings.layout != "mono":
        layout = replace(PAIR, right_first=layout.right_first or stated.right_first)
    layout = replace(layout, sample_aspect=stated.pixel_aspect)
    if settings.layout == "auto" and not is_pair:
        layout = replace(layout, right_first=layout.right_first or stated.right_first)
        height, width = picture.shape[:2]
        layout = of_film(layout, path, width_px=round(width * stated.pixel_aspect), height_px=height)
        if layout.kind == "mono" and not stated.left_out:
            _suggest(path, picture)
    return layout


def _why_none(folder: Path) -> str:
    """Return an error message that explains why no pictures were found in a folder."""
    if problem := camera_set_in(folder):
        return problem
    message = "the folder contains no pictures"
    for inner in sorted(item for item in folder.iterdir() if item.is_dir()):
        if any(item.suffix.lower() in PICTURES for item in inner.iterdir()):
            return f"{message}; to show the pictures in {inner.name}, pass that folder instead"
    return message


def read_pair(path: Path, settings: ContentSettings) -> list[U8]:
    """Read the left and right eye's views from one file, with square pixels, and white where they are
    transparent. Raises InputError if the file cannot be read, or if it does not contain exactly two views.
    """
    views = read_views(path)
    if len(views) == 2:
        return views
    layout = layout_of(path, settings, stated=header_of_file(path).layout)
    views = layout.views(views[0])
    if len(views) != 2:
        raise InputError(
            path, "layout", f"contains {len(views)} view{'s' * (len(views) > 1)}; pass --right or a different --layout"
        )
    height, width = views[0].shape[:2]
    aspect = layout.pixel_aspect(width_px=width, height_px=height)
    size = (round(width * max(aspect, 1)), round(height / min(aspect, 1)))
    return [np.asarray(cv2.resize(view, size, interpolation=cv2.INTER_CUBIC), np.uint8) for view in views]
