"""Solution geometry: windows on the panels, and homographies from rays to panel pixels.

Each ray belongs to one picture pixel. Content may be drawn on the middle panel's raster, on a window of it or on a
coarser raster; all of these differ from captured photographs only in the homography from picture to panel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import ceil, floor
from typing import NamedTuple

import numpy as np

from runtime.model.contract import Places
from runtime.optics.rect import PixelRect
from runtime.optics.stack import PanelStack, Plane, PlaneRaster
from runtime.optics.tilt import coarse_layer_from_seen, layer_pixels_from_seen
from runtime.optics.views import stack_from_eye
from runtime.records import F32, F64, U8, Eyes
from runtime.support.gl import DrawnPicture

PAD_PX = 2  # margin around the visible pixels
ALIGN_PX = 8  # boxes begin and end at multiples of this, so that rasters of half or quarter size have whole pixels
LEAST_PX = 32  # minimum side of a box
# Minimum homogeneous weight at a window's corner, relative to the window's centre. Smaller weights give no usable
# image.
MIN_WEIGHT = 0.05
SNAPPED = 1e-6  # a homography this close to a whole-pixel translation is treated as one
# Weight given to a ray that misses a panel. The other eye's ray through the same pixel may cross all panels, so
# reducing the weight gains 2 dB in two out of 12 pairs.
MISSING_WEIGHT = 1 / 8
# Head positions assumed by a step differ from the tracked one by at most this, because a person's head cannot be less
# certain, and by at most this share of the eyes' distance from the front panel.
SIGMA_MOST_M, SIGMA_MOST_SHARE = 0.1, 1 / 2
KNOWN_PX = 1 / 8  # tracking errors are ignored if they move an outer panel's picture by less than this
TAPERED_SHARE = 1 / 6  # rays fade in over this share of a window's taper; these rays correct the error at its edge
PLACES: dict[Places, tuple[tuple[float, float], ...]] = {  # head positions (right, up) in standard deviations
    "middle": ((0.0, 0.0),),
    "rising": ((1.0, 1.0), (-1.0, -1.0)),
    "falling": ((1.0, -1.0), (-1.0, 1.0)),
}


@dataclass(frozen=True, slots=True)
class TargetView:
    """A picture that one eye should see, and where its rays cross the middle panel's plane."""

    picture: U8 | DrawnPicture  # (h, w, 3 or 4) RGB or RGBA
    plane_from_picture: F64  # 3x3 homography from picture pixels (u, v, 1) to points (y, z, 1) in metres

    @property
    def pixels(self) -> U8:
        """The picture as an array. A texture is read back."""
        return self.picture.pixels() if isinstance(self.picture, DrawnPicture) else self.picture


class RaySets(NamedTuple):
    """The ray sets of one step: row k of the rays of a set with turn t is picture row `turns`·k + t."""

    panels_from_rays: F64  # (E, N, 3, 3) homographies from a set's rays to pixels in the panels' boxes
    views: tuple[int, ...]  # (E,) each set's view
    turn: tuple[int, ...]  # (E,)
    turns: int


@dataclass(frozen=True)
class Geometry:
    """The pixels that one solution computes, and the rays it considers."""

    stack: PanelStack
    eyes_m: Eyes  # (V, 3), frame `stack`
    boxes: tuple[PixelRect, ...]  # solved pixels of each panel
    kept: PixelRect  # part of the middle panel's box that rays pass through
    rays: PixelRect  # picture pixels whose rays pass through `kept`
    middle_from_rays: F64  # (V, 3, 3) for each eye, from pixels in `rays` to pixels in the middle panel's box
    taper_px: tuple[float, float]  # width of a window's taper, right and down, in middle-panel pixels
    points: int  # points of each pupil that have separate views; the views of each point in turn

    @property
    def middle(self) -> int:
        return self.stack.count // 2

    @property
    def missing_weight(self) -> float:
        """Weight of rays that miss another panel's box as the middle panel is solved: full in a taper."""
        return 1.0 if any(self.taper_px) else MISSING_WEIGHT

    def is_like(self, other: Geometry) -> bool:
        """Return True if the rays and boxes are equal, so that steps may continue from the other solution."""
        return (
            (self.stack, self.boxes, self.kept, self.rays, self.taper_px, self.points)
            == (other.stack, other.boxes, other.kept, other.rays, other.taper_px, other.points)
            and np.array_equal(self.eyes_m, other.eyes_m)
            and np.array_equal(self.middle_from_rays, other.middle_from_rays)
        )

    @cached_property
    def rasters(self) -> tuple[PlaneRaster, ...]:
        """The panels' pixel grids, cropped to their boxes."""
        return tuple(box.cut(self.stack.panel(n)) for n, box in enumerate(self.boxes))

    def ray_sets(self, places: Places, eye_sigma_m: float) -> RaySets:
        """Return one step's ray sets: every view at 1 or 2 head positions, which take turns. The tracking
        error's `eye_sigma_m` is limited so that all assumed eyes are in front of the panels.

        Points of a pupil are seen from the tracked head position alone. They are as far apart as a good tracker's
        errors, so a point that errs would ask for its neighbour's rays to show the point's own picture. A step takes
        the first point and half of the others: `rising` steps the first half, all other steps the second.
        """
        if self.points > 1:
            half, each = (self.points - 1) // 2 + 1, len(self.eyes_m) // self.points
            others = range(1, half) if places == "rising" else range(half, self.points)
            return self._sets(
                [[point * each + view for point in (0, *others) for view in range(each)]], np.zeros((1, 2))
            )
        eye_sigma_m = self._possible_m(eye_sigma_m)
        sure = self.rays.height_px == 1 or self._moved_px(eye_sigma_m) < KNOWN_PX
        positions = PLACES["middle" if sure else places]
        return self._sets([range(len(self.eyes_m))] * len(positions), eye_sigma_m * np.array(positions))

    def closing_sets(self) -> RaySets:
        """Return the ray sets for closing the middle panel: every view's rays, without tracking error."""
        return self._sets([range(len(self.eyes_m))], np.zeros((1, 2)))

    def _sets(self, shown: Sequence[Sequence[int]], moved_m: F64) -> RaySets:
        """Return ray sets, given, for each turn, its views and the head's offset (right, up)."""
        right, up = stack_from_eye(self.eyes_m.mean(axis=0))[:3, 0], np.array([0.0, 0.0, 1.0])
        turns, homographies = len(shown), []
        centre = np.array([self.rays.width_px / 2, self.rays.height_px / turns / 2, 1.0])
        for turn, (views, (across_m, up_m)) in enumerate(zip(shown, moved_m, strict=True)):
            rows = np.array([[1.0, 0.0, 0.0], [0.0, turns, turn + (1 - turns) / 2], [0.0, 0.0, 1.0]])
            for view in views:
                eye_m, from_rays = self.eyes_m[view] + across_m * right + up_m * up, self.middle_from_rays[view]
                between = [
                    panel_from_middle(self.stack, self.rasters, eye_m, n) if n != self.middle else np.eye(3)
                    for n in range(self.stack.count)
                ]
                seen = np.stack(between) @ from_rays @ rows
                homographies.append(seen / (seen[:, 2] @ centre)[:, None, None])
        turn_of = tuple(turn for turn, views in enumerate(shown) for _ in views)
        return RaySets(np.array(homographies), tuple(view for views in shown for view in views), turn_of, turns)

    def _possible_m(self, eye_sigma_m: float) -> float:
        """Return a standard deviation limited by the room that a person's head and the panels leave."""
        room_m = SIGMA_MOST_SHARE * max(float(self.eyes_m[:, 0].min()) - max(self.stack.x_m), 0.0)
        return min(eye_sigma_m, SIGMA_MOST_M, room_m)

    def _moved_px(self, eye_sigma_m: float) -> float:
        """Return the largest shift in any panel's picture, in pixels, if the eyes move by `eye_sigma_m`."""
        pitch_m, middle_x_m = self.stack.panel(self.middle).pitch_u_m, self.stack.x_m[self.middle]
        shares = [abs((x_m - middle_x_m) / (self.eyes_m[:, 0].mean() - middle_x_m)) for x_m in self.stack.x_m]
        return float(eye_sigma_m * max(shares) / pitch_m)

    def tapers(self) -> tuple[F32, F32]:
        """Return the rays' weights by column and row: 1 inside a window, 0 at edges that are not a panel's."""
        box, kept, matrix = self.boxes[self.middle], self.kept, self.middle_from_rays.mean(axis=0)
        width_px, height_px = self.rays.width_px, self.rays.height_px
        u = np.stack([np.arange(width_px) + 0.5, np.full(width_px, height_px / 2), np.ones(width_px)])
        v = np.stack([np.full(height_px, width_px / 2), np.arange(height_px) + 0.5, np.ones(height_px)])
        across, down = (matrix[axis] @ at / (matrix[2] @ at) for axis, at in ((0, u), (1, v)))
        return (
            taper(across + box.u0, kept.u0, kept.u1, self.stack.width_px, self.taper_px[0] * TAPERED_SHARE),
            taper(down + box.v0, kept.v0, kept.v1, self.stack.height_px, self.taper_px[1] * TAPERED_SHARE),
        )


def inverse(homographies: F64) -> F64:
    """Return the inverses of (..., 3, 3) homographies, scaled to a last entry of 1 or -1."""
    back = np.linalg.inv(homographies)
    return np.asarray(back / np.abs(back[..., 2:, 2:]), np.float64)


def geometry_of(
    stack: PanelStack,
    eyes_m: Eyes,
    views: Sequence[TargetView],
    *,
    boxes: tuple[PixelRect, ...],
    kept: PixelRect | None = None,
    taper_px: tuple[float, float] = (0.0, 0.0),
    points: int = 1,
) -> Geometry:
    """Return the geometry for the rays that pass through a part of the middle panel, by default its box.
    `boxes` are the pixels to solve on each panel, `taper_px` a window's taper, right and down, in middle-panel pixels,
    and `points` the points of each pupil that have separate views. Raises ValueError if the views' pictures differ in
    size.
    """
    box = boxes[stack.count // 2]
    kept = kept or box
    if len(shapes := {view.picture.shape[:2] for view in views}) > 1:
        raise ValueError(f"the views' pictures must have one size, but have {sorted(shapes)}")
    middle_from_plane = stack.panel(stack.count // 2).raster_from_plane()
    middle_from_pictures = [_snapped(middle_from_plane @ view.plane_from_picture) for view in views]
    rays = _looked_through(np.asarray(np.linalg.inv(middle_from_pictures), np.float64), kept, views[0].picture.shape)
    first = np.array([[1.0, 0.0, rays.u0], [0.0, 1.0, rays.v0], [0.0, 0.0, 1.0]])
    to_box = np.array([[1.0, 0.0, -box.u0], [0.0, 1.0, -box.v0], [0.0, 0.0, 1.0]])
    middle_from_rays = np.stack([to_box @ matrix @ first for matrix in middle_from_pictures])
    return Geometry(stack, eyes_m, boxes, kept, rays, middle_from_rays, taper_px, points)


def _snapped(homography: F64) -> F64:
    """Round a homography that is almost a whole-pixel translation, so that sampling becomes copying."""
    normalised = np.asarray(homography / homography[2, 2], np.float64)
    whole = np.rint(normalised)
    return whole if np.abs(normalised - whole).max() < SNAPPED else normalised


def _looked_through(pictures_from_middle: F64, box: PixelRect, shape: tuple[int, ...]) -> PixelRect:
    """Return the smallest rectangle of picture pixels whose rays pass a middle-panel box for at least one eye."""
    height, width = shape[:2]
    corners = np.array([[box.u0, box.u1, box.u0, box.u1], [box.v0, box.v0, box.v1, box.v1], [1.0] * 4])
    centre = np.array([(box.u0 + box.u1) / 2, (box.v0 + box.v1) / 2, 1.0])
    ends = []
    for matrix in pictures_from_middle:
        x, y, w = (matrix / (matrix[2] @ centre)) @ corners
        if w.min() < MIN_WEIGHT:
            return PixelRect(0, 0, width, height)
        ends.append((x / w, y / w))
    low, high = np.floor(np.min(ends, axis=(0, 2)) + SNAPPED), np.ceil(np.max(ends, axis=(0, 2)) - SNAPPED)
    u0, v0 = int(np.clip(low[0], 0, width - 1)), int(np.clip(low[1], 0, height - 1))
    return PixelRect(u0, v0, int(np.clip(high[0], u0 + 1, width)), int(np.clip(high[1], v0 + 1, height)))


def panel_from_middle(stack: PanelStack, rasters: Sequence[PlaneRaster], eye_m: F64, n: int) -> F64:
    """Return the 3x3 homography, 1 in its last entry, from middle-panel pixels to panel `n`'s along an
    eye's rays. A scale and a shift unless the panels are tilted (`optics.tilt`). Rasters may cover only a part of their
    panels.
    """
    target = rasters[n]
    matrix = rasters[stack.count // 2].to(target, eye_m)
    if stack.tilt is not None:
        matrix = layer_pixels_from_seen(target, coarse_layer_from_seen(stack, n, eye_m)) @ matrix
    return np.asarray(matrix / matrix[2, 2], np.float64)


def visible_boxes(eyes_m: Eyes, stack: PanelStack) -> tuple[PixelRect, ...]:
    """Return each panel's padded box of pixels that an eye sees through all the other panels. No box is
    empty, even if the eyes see nothing through all panels.
    """
    planes, half = [Plane(x_m) for x_m in stack.x_m], np.array([stack.width_m, stack.height_m]) / 2
    middle = planes[stack.count // 2]
    lows, highs = [], []
    for eye_m in eyes_m:
        seen = [plane.scale_shift_to(middle, eye_m) for plane in planes]
        lows.append(np.max([shift - half * scale for scale, shift in seen], axis=0))
        highs.append(np.min([shift + half * scale for scale, shift in seen], axis=0))
    low, high = np.min(lows, axis=0), np.max(highs, axis=0)
    boxes = []
    for plane in planes:
        seen = [middle.scale_shift_to(plane, eye_m) for eye_m in eyes_m]
        corners = [corner * scale + shift for scale, shift in seen for corner in (low, high)]
        (left_m, bottom_m), (right_m, top_m) = np.min(corners, axis=0), np.max(corners, axis=0)
        u0, u1 = _span(left_m / stack.width_m + 0.5, right_m / stack.width_m + 0.5, stack.width_px)
        v0, v1 = _span(0.5 - top_m / stack.height_m, 0.5 - bottom_m / stack.height_m, stack.height_px)
        boxes.append(PixelRect(u0, v0, u1, v1))
    return tuple(boxes)


def _span(low: float, high: float, size: int) -> tuple[int, int]:
    first, last = max(0, floor(low * size) - PAD_PX), min(size, ceil(high * size) + PAD_PX)
    first, last = first // ALIGN_PX * ALIGN_PX, min(size, -(-last // ALIGN_PX) * ALIGN_PX)
    least = min(LEAST_PX, size)
    if last - first < least:
        first = min(max(0, (first + last - least) // 2), size - least)
        last = first + least
    return first, last


def taper(at_px: F64, first: int, last: int, size: int, over_px: float) -> F32:
    """Return weights that rise linearly from 0 at two limits to 1 within `over_px`, but not at panel
    edges.
    """
    weights = np.ones(len(at_px))
    if over_px > 0 and first > 0:
        weights = np.minimum(weights, (at_px - first) / over_px)
    if over_px > 0 and last < size:
        weights = np.minimum(weights, (last - at_px) / over_px)
    return np.clip(weights, 0.0, 1.0).astype(np.float32)
