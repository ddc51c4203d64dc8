"""Geometry of a solution: the panels' windows, and homographies from rays to panel pixels.

Each ray belongs to one pixel of a picture. Drawn content (on the middle panel's raster, a window of it or a coarser
raster) and captured photographs differ only in the homography from picture to panel.
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

PAD_PX = 2  # margin around the visible pixels
ALIGN_PX = 8  # boxes begin and end at multiples of this, so that rasters of a half or a quarter have whole pixels
LEAST_PX = 32
MIN_WEIGHT = 0.05  # least homogeneous weight of a window's corner, relative to its middle, that gives a usable image
SNAPPED = 1e-6  # a homography within this many pixels of a whole-pixel translation counts as one
# Weight of rays that miss a panel, worth 2 dB in two of 12 pairs: the other eye's ray through the pixel may cross all.
MISSING_WEIGHT = 1 / 8
KNOWN_PX = 1 / 8  # tracking errors that move an outer panel's picture by less than this are ignored
TAPERED_SHARE = 1 / 6  # share of a window's taper over which its rays fade in; these rays correct the error at its edge
PLACES: dict[Places, tuple[tuple[float, float], ...]] = {  # head positions (right, up) in sigmas
    "middle": ((0.0, 0.0),),
    "rising": ((1.0, 1.0), (-1.0, -1.0)),
    "falling": ((1.0, -1.0), (-1.0, 1.0)),
}


@dataclass(frozen=True, slots=True)
class TargetView:
    """The picture that one eye should see, and where its rays cross the middle panel's plane."""

    picture: U8 | DrawnPicture  # (h, w, 3 or 4) RGB or RGBA
    plane_from_picture: F64  # 3x3, (y, z, 1) on the plane in metres from the picture's pixels (u, v, 1)

    @property
    def pixels(self) -> U8:
        """Picture as an array, read back if it is in a texture."""
        return self.picture.pixels() if isinstance(self.picture, DrawnPicture) else self.picture


@dataclass(frozen=True)
class Geometry:
    """Boxes of the panels and raster of rays for one solution."""

    stack: PanelStack
    eyes_m: F64  # (2, 3) left and right, frame `stack`
    boxes: tuple[PixelRect, ...]  # solved pixels of each panel
    kept: PixelRect  # pixels of the middle panel's box through which rays pass
    rays: PixelRect  # box of the pictures' pixels whose rays pass through `kept`
    middle_from_rays: F64  # (2, 3, 3) for each eye, pixels of the middle panel's box from pixels of `rays`
    taper_px: tuple[float, float] = (0.0, 0.0)  # middle-panel pixels, right and down, over which rays fade

    @property
    def middle(self) -> int:
        return self.stack.count // 2

    @property
    def missing_weight(self) -> float:
        """Weight of rays that miss another panel's box, for solving the middle panel; 1 with a window."""
        return 1.0 if any(self.taper_px) else MISSING_WEIGHT

    def is_like(self, other: Geometry) -> bool:
        """Return True if rays and boxes are equal, so that steps may continue from the other's solution."""
        return (
            (self.stack, self.boxes, self.kept, self.rays, self.taper_px)
            == (other.stack, other.boxes, other.kept, other.rays, other.taper_px)
            and np.array_equal(self.eyes_m, other.eyes_m)
            and np.array_equal(self.middle_from_rays, other.middle_from_rays)
        )

    @cached_property
    def rasters(self) -> tuple[PlaneRaster, ...]:
        """Pixel grids of the panels, cropped to their boxes."""
        return tuple(box.cut(self.stack.panel(n)) for n, box in enumerate(self.boxes))

    def panels_from_rays(self, places: Places, eye_sigma_m: float) -> F64:
        """Return (2P, N, 3, 3) homographies from rays to pixels of the panels' boxes.

        The first axis lists, for each of P head positions, the left and the right eye. The positions take turns at
        the rows of a picture: row k of the rays for position p is row P·k + p of the picture.
        """
        right, up = stack_from_eye(self.eyes_m.mean(axis=0))[:3, 0], np.array([0.0, 0.0, 1.0])
        sure = self.rays.height_px == 1 or self._moved_px(eye_sigma_m) < KNOWN_PX
        positions = PLACES["middle" if sure else places]
        turns, homographies = len(positions), []
        centre = np.array([self.rays.width_px / 2, self.rays.height_px / turns / 2, 1.0])
        for turn, (across, down) in enumerate(positions):
            rows = np.array([[1.0, 0.0, 0.0], [0.0, turns, turn + (1 - turns) / 2], [0.0, 0.0, 1.0]])
            moved_m = eye_sigma_m * (across * right + down * up)
            for eye_m, from_rays in zip(self.eyes_m + moved_m, self.middle_from_rays, strict=True):
                between = [
                    panel_from_middle(self.stack, self.rasters, eye_m, n) if n != self.middle else np.eye(3)
                    for n in range(self.stack.count)
                ]
                seen = np.stack(between) @ from_rays @ rows
                homographies.append(seen / (seen[:, 2] @ centre)[:, None, None])
        return np.array(homographies)

    def _moved_px(self, eye_sigma_m: float) -> float:
        """Return the largest shift in pixels, over all panels, that one sigma of the eyes causes."""
        pitch_m, middle_x_m = self.stack.panel(self.middle).pitch_u_m, self.stack.x_m[self.middle]
        shares = [abs((x_m - middle_x_m) / (self.eyes_m[:, 0].mean() - middle_x_m)) for x_m in self.stack.x_m]
        return float(eye_sigma_m * max(shares) / pitch_m)

    def tapers(self) -> tuple[F32, F32]:
        """Return weights of the rays by column (width,) and row (height,): 0 at a window's edges, 1 inside."""
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
    """Return the inverses (..., 3, 3) divided by the magnitude of their last entry, which keeps its sign."""
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
    """Return the geometry of both views' rays through `kept` of the middle panel (default: its box)."""
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
    """Round a homography that is almost a whole-pixel translation, so that sampling becomes a copy."""
    normalised = np.asarray(homography / homography[2, 2], np.float64)
    whole = np.rint(normalised)
    return whole if np.abs(normalised - whole).max() < SNAPPED else normalised


def _looked_through(pictures_from_middle: F64, box: PixelRect, shape: tuple[int, ...]) -> PixelRect:
    """Return the box of pixels, in pictures of a shape (h, w, ...), whose rays pass through `box`.

    box: of the middle panel. A pixel counts if its ray in either eye passes.
    """
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
    """Return the 3x3 map, for an eye (3,), from the middle panel's pixels to those of panel `n`.

    Its last entry is 1. It is a scale and a shift unless panels are tilted (`optics.tilt`).
    """
    source, target = rasters[stack.count // 2], rasters[n]
    scale, shift_m = relative_scale_shift(eye_m, from_x_m=source.x_m, to_x_m=target.x_m)
    across = np.array([[scale, 0.0, shift_m[0]], [0.0, scale, shift_m[1]], [0.0, 0.0, 1.0]])
    matrix: F64 = target.raster_from_plane() @ across @ source.plane_from_raster()
    if stack.tilt is not None:
        matrix = layer_pixels_from_seen(target, coarse_layer_from_seen(stack, n, eye_m)) @ matrix
    return np.asarray(matrix / matrix[2, 2], np.float64)


def visible_boxes(eyes_m: F64, stack: PanelStack) -> tuple[PixelRect, ...]:
    """Return, for each panel, the padded box of pixels that the eyes (2, 3) see through every panel.

    If an eye sees nothing through all panels, the result is a small box in the middle, as there is nothing to solve.
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
    """Return weights that rise from 0 at `first` and `last` to 1 at `over_px` inside them.

    A limit at the edge of the panel (0 or `size`) has no ramp. at_px: positions of the weights.
    """
    weights = np.ones(len(at_px))
    if over_px > 0 and first > 0:
        weights = np.minimum(weights, (at_px - first) / over_px)
    if over_px > 0 and last < size:
        weights = np.minimum(weights, (last - at_px) / over_px)
    return np.clip(weights, 0.0, 1.0).astype(np.float32)
