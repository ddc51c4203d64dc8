"""The rays of a solution: targets, the panels' windows, and homographies from rays to panel pixels.

A ray belongs to a pixel of a picture. Only that homography distinguishes content that was
drawn on the middle panel's raster, in a window of it or on a coarser one, and captured photographs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import ceil, floor

import numpy as np

from runtime.model.contract import Places
from runtime.optics.rect import PixelRect
from runtime.optics.stack import PanelStack, PlaneRaster
from runtime.optics.tilt import coarse_layer_from_seen, layer_pixels_from_seen
from runtime.optics.views import relative_scale_shift, stack_from_eye
from runtime.records import F32, F64, U8
from runtime.support.gl import DrawnPicture

PAD_PX = 2  # around the visible pixels
ALIGN_PX = 8  # boxes begin and end at multiples of this, so that the network's raster (a half, a quarter) is whole
LEAST_PX = 32
MIN_WEIGHT = 0.05  # least homogeneous weight of a window's corner relative to its middle: below, it has no image
SNAPPED = 1e-6  # pixels by which a homography may miss whole pixels and still count as a translation by them
MISSING_WEIGHT = 1 / 8  # 2 dB in two pairs of twelve: the other eye's ray through such a pixel may cross all panels
KNOWN_PX = 1 / 8  # eye errors that move an outer panel's picture by less than this are ignored
TAPERED_SHARE = 1 / 6  # share of a window's taper over which its rays fade: they correct the error of its edge
PLACES: dict[Places, tuple[tuple[float, float], ...]] = {  # right and up, standard deviations of the eyes' place
    "middle": ((0.0, 0.0),),
    "rising": ((1.0, 1.0), (-1.0, -1.0)),
    "falling": ((1.0, -1.0), (-1.0, 1.0)),
}


@dataclass(frozen=True, slots=True)
class TargetView:
    """The picture that one eye should see, and where its pixels' rays cross the middle panel's plane."""

    picture: U8 | DrawnPicture  # (h, w, 3 or 4) RGB or RGBA
    plane_from_picture: F64  # 3x3: (y, z, 1) on the plane, metres, from the picture's pixels (u, v, 1)

    @property
    def pixels(self) -> U8:
        """The picture as an array, read back where it was left in a texture."""
        return self.picture.pixels() if isinstance(self.picture, DrawnPicture) else self.picture


@dataclass(frozen=True)
class Geometry:
    """Panels' boxes and the raster of rays of one solution."""

    stack: PanelStack
    eyes_m: F64  # (2, 3) left and right, frame `stack`
    boxes: tuple[PixelRect, ...]  # solved pixels of each panel
    kept: PixelRect  # pixels of the middle panel's box that rays look through
    rays: PixelRect  # pixels of the views' pictures that look through `kept`
    middle_from_rays: F64  # (2, 3, 3) for each eye: the middle panel's pixels (0: its box's first) from rays (0: first)
    taper_px: tuple[float, float] = (0.0, 0.0)  # pixels of the middle panel, right and down, over which rays fade

    @property
    def middle(self) -> int:
        return self.stack.count // 2

    @property
    def missing_weight(self) -> float:
        """Weight of a ray that misses a box in solving the middle panel; 1 with a window, outside which panels rest."""
        return 1.0 if any(self.taper_px) else MISSING_WEIGHT

    def is_like(self, other: Geometry) -> bool:
        """True where rays and boxes are the same: panels solved for one are where steps for the other may begin."""
        return (
            (self.stack, self.boxes, self.kept, self.rays, self.taper_px)
            == (other.stack, other.boxes, other.kept, other.rays, other.taper_px)
            and np.array_equal(self.eyes_m, other.eyes_m)
            and np.array_equal(self.middle_from_rays, other.middle_from_rays)
        )

    @cached_property
    def rasters(self) -> tuple[PlaneRaster, ...]:
        """The panels' pixels within their boxes."""
        return tuple(box.cut(self.stack.panel(n)) for n, box in enumerate(self.boxes))

    def panels_from_rays(self, places: Places, eye_sigma_m: float) -> F64:
        """(2P, N, 3, 3) panel pixels (from the box's first), P positions of the head, left and right eye alternately.

        Positions alternate from row to row of a picture: row k of position p's rays is the picture's row P·k + p.
        """
        right, up = stack_from_eye(self.eyes_m.mean(axis=0))[:3, 0], np.array([0.0, 0.0, 1.0])
        sure = self.rays.height_px == 1 or self._moved_px(eye_sigma_m) < KNOWN_PX
        taken = PLACES["middle" if sure else places]
        turns, found = len(taken), []
        centre = np.array([self.rays.width_px / 2, self.rays.height_px / turns / 2, 1.0])
        for turn, (across, down) in enumerate(taken):
            rows = np.array([[1.0, 0.0, 0.0], [0.0, turns, turn + (1 - turns) / 2], [0.0, 0.0, 1.0]])
            moved_m = eye_sigma_m * (across * right + down * up)
            for eye_m, from_rays in zip(self.eyes_m + moved_m, self.middle_from_rays, strict=True):
                between = [
                    panel_from_middle(self.stack, self.rasters, eye_m, n) if n != self.middle else np.eye(3)
                    for n in range(self.stack.count)
                ]
                seen = np.stack(between) @ from_rays @ rows
                found.append(seen / (seen[:, 2] @ centre)[:, None, None])
        return np.array(found)

    def _moved_px(self, eye_sigma_m: float) -> float:
        """Largest displacement of a panel's picture against the middle one, for one sigma of the eyes."""
        pitch_m, middle_x_m = self.stack.panel(self.middle).pitch_u_m, self.stack.x_m[self.middle]
        shares = [abs((x_m - middle_x_m) / (self.eyes_m[:, 0].mean() - middle_x_m)) for x_m in self.stack.x_m]
        return float(eye_sigma_m * max(shares) / pitch_m)

    def tapers(self) -> tuple[F32, F32]:
        """(width,) and (height,) what rays' errors are multiplied with: 0 at a window's edges to 1 inside."""
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
    """(..., 3, 3) the way back, of the same sign before the eye, last entries 1."""
    back = np.linalg.inv(homographies)
    return np.asarray(back / np.abs(back[..., 2:, 2:]), np.float64)


def geometry_of(
    stack: PanelStack,
    eyes_m: F64,
    views: Sequence[TargetView],
    *,
    boxes: tuple[PixelRect, ...],
    kept: PixelRect | None = None,
    taper_px: tuple[float, float] = (0.0, 0.0),
) -> Geometry:
    """Rays of both views' pixels through `kept` of the middle panel (None: its whole box); `boxes` of each panel."""
    box = boxes[stack.count // 2]
    kept = kept or box
    middle_from_plane = stack.panel(stack.count // 2).raster_from_plane()
    middle_from_pictures = [_snapped(middle_from_plane @ view.plane_from_picture) for view in views]
    rays = _looked_through(np.asarray(np.linalg.inv(middle_from_pictures), np.float64), kept, views[0].picture.shape)
    first = np.array([[1.0, 0.0, rays.u0], [0.0, 1.0, rays.v0], [0.0, 0.0, 1.0]])
    to_box = np.array([[1.0, 0.0, -box.u0], [0.0, 1.0, -box.v0], [0.0, 0.0, 1.0]])
    middle_from_rays = np.stack([to_box @ matrix @ first for matrix in middle_from_pictures])
    return Geometry(stack, eyes_m, boxes, kept, rays, middle_from_rays, taper_px)


def _snapped(homography: F64) -> F64:
    """Exact where it takes pixels to pixels: sampling is then a copy."""
    normalised = np.asarray(homography / homography[2, 2], np.float64)
    whole = np.rint(normalised)
    return whole if np.abs(normalised - whole).max() < SNAPPED else normalised


def _looked_through(pictures_from_middle: F64, box: PixelRect, shape: tuple[int, ...]) -> PixelRect:
    """Pixels of either picture (h, w, ...) that look through a box of the middle panel."""
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
    """3x3, last entry 1: panel n's pixels from the middle one's, as an eye (3,) sees them in line.

    A scale and a shift, but where panels are tilted (`optics.tilt`).
    """
    source, target = rasters[stack.count // 2], rasters[n]
    scale, shift_m = relative_scale_shift(eye_m, from_x_m=source.x_m, to_x_m=target.x_m)
    across = np.array([[scale, 0.0, shift_m[0]], [0.0, scale, shift_m[1]], [0.0, 0.0, 1.0]])
    matrix: F64 = target.raster_from_plane() @ across @ source.plane_from_raster()
    if stack.tilt is not None:
        matrix = layer_pixels_from_seen(target, coarse_layer_from_seen(stack, n, eye_m)) @ matrix
    return np.asarray(matrix / matrix[2, 2], np.float64)


def visible_boxes(eyes_m: F64, stack: PanelStack) -> tuple[PixelRect, ...]:
    """For each panel the pixels on rays of either eye (2, 3) that cross every panel, a little padded.

    Where an eye sees nothing through all panels, a small box in the middle: there is nothing to solve.
    """
    middle_x_m, half = stack.x_m[stack.count // 2], np.array([stack.width_m, stack.height_m]) / 2
    lows, highs = [], []
    for eye_m in eyes_m:
        seen = [relative_scale_shift(eye_m, from_x_m=x_m, to_x_m=middle_x_m) for x_m in stack.x_m]
        lows.append(np.max([shift - half * scale for scale, shift in seen], axis=0))
        highs.append(np.min([shift + half * scale for scale, shift in seen], axis=0))
    low, high = np.min(lows, axis=0), np.max(highs, axis=0)
    boxes = []
    for x_m in stack.x_m:
        seen = [relative_scale_shift(eye_m, from_x_m=middle_x_m, to_x_m=x_m) for eye_m in eyes_m]
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
    """Ramp from 0 at pixels `first` and `last` to 1 `over_px` inside, except at the edges of a panel of `size`."""
    weights = np.ones(len(at_px))
    if over_px > 0 and first > 0:
        weights = np.minimum(weights, (at_px - first) / over_px)
    if over_px > 0 and last < size:
        weights = np.minimum(weights, (last - at_px) / over_px)
    return np.clip(weights, 0.0, 1.0).astype(np.float32)
