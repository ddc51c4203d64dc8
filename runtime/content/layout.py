"""Arrangement of views in a picture, by settings, header, name, or, as a hint, similar halves."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from runtime.config import ContentSettings
from runtime.errors import InputError
from runtime.records import F32, U8

QUILT = re.compile(r"(?<![a-z0-9])qs([0-9]{1,6})x([0-9]{1,6})(?:a([0-9]*\.?[0-9]+))?(?![0-9])")
ASPECT_MIN, ASPECT_MAX = 0.05, 20.0  # width over height of one view
RIGHT_FIRST = (".jps", ".pns")  # formats that are side by side and cross-eyed by convention
MARKS = {  # words accepted anywhere in a name
    "half-side-by-side": "(half|h) ?(sbs|side by side|lr|left right)|sbs h(alf)?",
    "half-top-bottom": "(half|h) ?(tb|tab|over under|top bottom)|(half|h|3d) (ou|hou)|halfou|(ou|tb|tab) half",
    "cross-eyed": "cross ?eyed?|crossview|sbs rl",
    "side-by-side": "f?sbs|side by side|sidebyside|3dh|3d (lr|left right)",
    "top-bottom": "over under|overunder|3dv|3d (ou|tb|tab|top bottom)",
    "anaglyph": "anaglyph",
    "rgbd": "rgbd",
}
LAST_MARKS = {  # ambiguous words, accepted only at the end or before words with digits, such as 1080p
    "half-top-bottom": "hou",
    "cross-eyed": "rl|right left",
    "side-by-side": "lr|left right|2x1|parallel",
    "top-bottom": "ou|tb|tab|top bottom|1x2",
}
COPY = re.compile(r"( copy)?( ?\([0-9]+\))?$")  # suffix added to a copy's name by a browser or desktop
NARROW, LOW = 2.5, 1.28  # a film is squeezed if its aspect ratio is below (side-by-side) or above (top-bottom) this
FULL = re.compile(r"(^|[^a-z])(full|fsbs|ftb|fou)")  # mark in the names of films whose views are not squeezed
ALIKE = 0.8  # a picture's halves may be two views if their correlation exceeds this
SMALL_PX = (64, 48)  # halves are reduced to this size for comparison
SHIFT_PX = 6  # largest shift between views, in pixels of the reduced halves
ROUGH = 6.0  # least standard deviation in 8-bit values; smoother halves always correlate, so they are not compared


@dataclass(frozen=True, slots=True)
class Layout:
    """A picture's view arrangement. The method `views` splits a picture accordingly."""

    kind: str  # mono, rgbd, quilt, side-by-side, top-bottom or anaglyph
    columns: int = 1
    rows: int = 1
    half: bool = False  # True if the views are squeezed to half their width or height
    right_first: bool = False  # True if the right eye's view comes first
    view_aspect: float = 0.0  # width over height of a quilt's views, or 0 if their pixels are square
    sample_aspect: float = 1.0  # width over height of a film's pixels

    def views(self, picture: U8) -> list[U8]:
        """Split a picture into [left, right], a single view, or a quilt's views from the leftmost to the
        rightmost camera. Raises ValueError if the picture is smaller than one pixel per view.
        """
        height, width = picture.shape[:2]
        if not 0 < self.columns <= width or not 0 < self.rows <= height:
            raise ValueError(
                f"a picture of {width} x {height} pixels cannot contain {self.columns} x {self.rows} views"
            )
        if self.kind == "anaglyph":  # the left eye's view is red, the right eye's view is cyan
            cyan = cv2.addWeighted(picture[..., 1], 0.8, picture[..., 2], 0.2, 0)
            return [np.repeat(np.asarray(part)[..., None], 3, axis=2) for part in (picture[..., 0], cyan)]
        wide, high = width // self.columns, height // self.rows
        if self.kind != "quilt":  # an odd pixel in the middle belongs to neither view
            rows, columns = (0, height - high)[: self.rows], (0, width - wide)[: self.columns]
            views = [picture[v : v + high, u : u + wide] for v in rows for u in columns]
            return views[::-1] if self.right_first else views
        # A quilt starts at the bottom left and continues to the right, then upwards.
        return [
            picture[height - (row + 1) * high : height - row * high, column * wide : (column + 1) * wide]
            for row in range(self.rows)
            for column in range(self.columns)
        ]

    def pixel_aspect(self, *, width_px: int, height_px: int) -> float:
        """Return the aspect ratio (width over height) of the pixels in a view of the given size."""
        if self.half:
            return self.sample_aspect * (self.columns if self.columns > 1 else 1 / self.rows)
        return self.view_aspect * height_px / width_px if self.view_aspect else self.sample_aspect


MONO, PAIR = Layout("mono"), Layout("side-by-side", columns=2)  # PAIR is for files with two pictures in them


def layout_of(path: Path, settings: ContentSettings, *, stated: str = "") -> Layout:
    """Return a file's or folder's layout from the settings, its header (`stated`, as in `content.layout`)
    or its name. Raises InputError if a quilt has no views, or an implausible aspect ratio.
    """
    named = settings.layout
    if named == "auto":
        named = stated or _named(path)
    if found := QUILT.search(named):
        columns, rows, aspect = int(found[1]), int(found[2]), float(found[3] or 0)
        if not columns or not rows:
            raise InputError(path, "layout", f"a quilt cannot have {columns} x {rows} views")
        if aspect and not ASPECT_MIN <= aspect <= ASPECT_MAX:
            problem = f"the aspect ratio of a view must be from {ASPECT_MIN:g} to {ASPECT_MAX:g}, not {aspect:g}"
            raise InputError(path, "layout", problem)
        return Layout("quilt", columns, rows, view_aspect=aspect)
    kind = named.removeprefix("half-").replace("cross-eyed", "side-by-side")
    columns, rows = {"side-by-side": (2, 1), "top-bottom": (1, 2)}.get(kind, (1, 1))
    return Layout(kind, columns, rows, half=named.startswith("half-"), right_first=named.endswith("cross-eyed"))


def of_film(layout: Layout, path: Path, *, width_px: int, height_px: int) -> Layout:
    """Return a film's layout, with squeezed views if the frame has the shape of a single view. A mark
    such as `full` in its name means that the views are not squeezed.
    """
    aspect = width_px / height_px
    squeezed = {"side-by-side": aspect < NARROW, "top-bottom": aspect > LOW}.get(layout.kind, False)
    is_half = squeezed and not FULL.search(path.stem.lower())
    return replace(layout, half=layout.half or is_half)


def _named(path: Path) -> str:
    """Return the layout stated by a file or folder name, in the syntax of `content.layout`."""
    if path.suffix.lower() in RIGHT_FIRST:
        return "cross-eyed"
    stem = COPY.sub("", path.name if path.is_dir() else path.stem).lower()
    if QUILT.search(stem):
        return stem
    words = " ".join(re.split(r"[^a-z0-9]+", stem)) + " "
    for marks, rest in ((MARKS, r" .*"), (LAST_MARKS, r" (\S*[0-9]\S* )*")):
        for layout, mark in marks.items():
            if re.search(rf"(^|.* )({mark}){rest}$", words):
                return layout
    return "mono"


def hint(picture: U8) -> str:
    """Return a picture's probable layout, or "": halves that correlate after a small shift may be views."""
    for layout in ("side-by-side", "top-bottom"):
        columns = 2 if layout == "side-by-side" else 1
        if min(picture.shape[0] * columns, picture.shape[1] * (3 - columns)) < 4 * SMALL_PX[0]:
            continue
        views = Layout(layout, columns, 3 - columns).views(picture)
        first, second = (_detail(view) for view in views)
        if min(first.std(), second.std()) < ROUGH:
            continue
        middle = first[2:-2, SHIFT_PX:-SHIFT_PX]
        if cv2.matchTemplate(second, middle, cv2.TM_CCOEFF_NORMED).max() > ALIKE:
            return layout
    return ""


def _detail(view: U8) -> F32:
    """Reduce a view to a small grey picture for comparison, high-pass filtered because smooth areas look alike."""
    small = cv2.cvtColor(cv2.resize(view, SMALL_PX, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY)
    return np.asarray(small.astype(np.float32) - cv2.GaussianBlur(small, (0, 0), 8).astype(np.float32), np.float32)
