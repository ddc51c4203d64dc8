"""Reduce a job to the window where the eyes' pictures differ, and to one channel if they are grey.

A window of the panels is equivalent to a smaller stack with its origin at the window's centre and the eyes shifted
accordingly. Outside the window, the outer panels have the rest value, and the centre panel shows the picture. To avoid
a visible seam, the outer panels' values are tapered to the rest value at the window's edge (`Geometry.tapers`).

The previous solution's window, `before`, is kept if it still fits. The window is None if solving the
whole panel would be as fast.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from runtime.model.geometry import TargetView
from runtime.model.job import NOWHERE, Job, SolveWindow
from runtime.model.targets import is_grey
from runtime.model.warp import picture_on
from runtime.optics.rect import PixelRect, union
from runtime.optics.stack import PanelStack, Plane
from runtime.records import F64, U8, Eyes
from runtime.support.gl import DrawnPicture
from runtime.support.threads import PIECE_ROWS, parallel_map

TOLERANCE_CODES = 2  # differences up to this are ignored; at 40 dB, this error is a tenth of the 8-bit quantisation's
COARSE_STEP = 16  # sample spacing in pixels for a quick comparison, which may make an exact one unnecessary
MAX_SHARE = 0.6  # a window that covers more than this share of the panel is as slow as the whole panel
MAX_SLACK = 1.3  # maximum size of a window kept from the previous solution, relative to the one needed
WINDOW_SHARES = 16  # window sides are whole sixteenths of the panel's, which limits the number of shapes
# Measured with the shipped models: if the outer panels are tapered over 14 parallaxes around a region where the
# pictures differ, 0.06 dB is lost on a mid-grey background, where sin² is steepest. Over 6 parallaxes, up to 0.4 dB is
# lost there, but only 0.02 dB on white or black, where sin² is level. A window must also contain the points where its
# rays cross the other panels.
TAPER_PARALLAXES = (6.0, 14.0)  # taper width for a steepness of 0 and for a steepness of 1
PANEL_CROSSINGS = 2.0
MARGIN_PX = 16
EDGE_PX = 2
COMPARED = 2  # captured pictures are compared on a raster this many times as coarse as the panels'


def trim(job: Job, before: SolveWindow | None = None) -> Job:
    """Return a job that solves only its window, or where pictures differ, and one channel if grey."""
    window = job.window or differing_window(job, before)
    grey = (window is None or window.box.width_px > 0) and all(_is_grey(view, job, window) for view in job.views)
    return replace(job, window=window, channels=1 if grey else job.channels)


def extent_window(
    extent: PixelRect, colour: tuple[int, ...], eyes_m: Eyes, stack: PanelStack, before: SolveWindow | None = None
) -> SolveWindow | None:
    """Return the window for content whose extent, in middle-panel pixels, is known before it is drawn.
    Outside, both eyes see only the background, whose codes are `colour`. None also if the extent is empty.
    """
    if not extent.width_px:
        return None
    steep = max(steepness(np.array([code], np.uint8)) for code in colour)
    window = _window_around(extent, eyes_m, stack, before, steep=steep)
    return window and replace(window, colour=colour)


def differing_window(job: Job, before: SolveWindow | None = None) -> SolveWindow | None:
    """Return the window where pictures differ, maybe empty. None also if a picture is in a texture."""
    if any(isinstance(view.picture, DrawnPicture) for view in job.views):
        return None
    stack = job.stack
    if all(_on_middle_panel(view, stack) for view in job.views):
        pictures = [view.pixels for view in job.views]
        origin, scale = (0, 0), 1
    else:
        pictures, origin = _compared(job)
        scale = COMPARED
    first, *others = pictures

    def window_of(box: PixelRect) -> SolveWindow | None:
        grown = PixelRect(*(begin + scale * at for begin, at in zip((*origin, *origin), box.corners, strict=True)))
        return _window_around(grown, job.eyes_m, stack, before, steep=steepness_beside(first, box))

    # A quick comparison recognises windows that would be too large. An exact comparison is needed only for the others.
    box, window = union([NOWHERE, *(coarse_box(first, other) for other in others)]), None
    if box.width_px:
        window = window_of(box)
    if not box.width_px or window is not None:
        for other in others:
            box = differing_box(first, other, known=box)
        window = window_of(box) if box.width_px else SolveWindow(NOWHERE, NOWHERE, (0.0, 0.0))
    return window


def _on_middle_panel(view: TargetView, stack: PanelStack) -> bool:
    """Return True if a view's picture pixels coincide with the middle panel's pixels."""
    middle = stack.panel(stack.count // 2)
    same_size = view.picture.shape[:2] == (stack.height_px, stack.width_px)
    return same_size and np.allclose(view.plane_from_picture, middle.plane_from_raster(), rtol=0, atol=1e-9)


def _compared(job: Job) -> tuple[list[U8], tuple[int, int]]:
    """Return pictures on a coarse raster of the middle panel's visible part, and that raster's first (column, row)."""
    visible = job.targets.visible
    box, middle = visible.boxes[visible.middle], job.stack.panel(visible.middle)
    size = max(1, box.height_px // COMPARED), max(1, box.width_px // COMPARED)
    middle_from_compared = np.array([
        [box.width_px / size[1], 0.0, box.u0],
        [0.0, box.height_px / size[0], box.v0],
        [0.0, 0.0, 1.0],
    ])  # fmt: skip
    pictures = [
        picture_on(view, middle, middle_from_result=middle_from_compared, edge=cv2.BORDER_REPLICATE, size=size)
        for view in job.targets.reduced(COMPARED)
    ]
    return pictures, (box.u0, box.v0)


def _window_around(
    box: PixelRect, eyes_m: Eyes, stack: PanelStack, before: SolveWindow | None, *, steep: float
) -> SolveWindow | None:
    """Return the window for a box where pictures differ on a background with a `steepness`."""
    parallaxes = taper_parallaxes(steep)
    window = window_around(box, eyes_m, stack, parallaxes=parallaxes)
    if window is None:
        return None
    if before is not None and still_fits(before.box, window):
        window = before.box
    # Rays near the window's edge leave the window on another panel, so they give the centre panel no valid target.
    return SolveWindow(window, whole_rays(window, eyes_m, stack), taper_px(eyes_m, stack, parallaxes=parallaxes))


def _is_grey(view: TargetView, job: Job, window: SolveWindow | None) -> bool:
    """Return True if the pixels to solve are grey. A texture counts as grey only if it is marked as such."""
    if isinstance(view.picture, DrawnPicture):
        return view.picture.grey
    if window is not None and _on_middle_panel(view, job.stack):
        return is_grey(view.picture[window.box.slices])
    return is_grey(view.picture)


def differing_box(left: U8, right: U8, *, known: PixelRect = NOWHERE) -> PixelRect:
    """Return the smallest box, maybe empty, of all differences above `TOLERANCE_CODES` between (h, w, 3
    or 4) pictures. Pixels in `known`, a part of the result such as that of `coarse_box`, are not compared.
    """
    height, width = left.shape[:2]

    def look(part: PixelRect) -> PixelRect:
        box = _box(left[part.slices], right[part.slices])
        return PixelRect(box.u0 + part.u0, box.v0 + part.v0, box.u1 + part.u0, box.v1 + part.v0)

    parts = known.beside(width_px=width, height_px=height)
    return union([known, *parallel_map(look, [piece for part in parts for piece in part.in_rows(PIECE_ROWS)])])


def coarse_box(left: U8, right: U8) -> PixelRect:
    """Return a box inside the result of `differing_box`, in a hundredth of the time. Only a few pixels
    are compared, enough to tell if the window would be too large to be useful.
    """
    few = [np.ascontiguousarray(picture[::COARSE_STEP, ::COARSE_STEP]) for picture in (left, right)]
    u0, v0, u1, v1 = (COARSE_STEP * corner for corner in _box(few[0], few[1]).corners)
    return PixelRect(u0, v0, u1 - COARSE_STEP + 1, v1 - COARSE_STEP + 1) if u1 > u0 else NOWHERE


def _box(left: U8, right: U8) -> PixelRect:
    difference = cv2.absdiff(left, right)
    agree = cv2.inRange(difference, (0, 0, 0, 0), (*[TOLERANCE_CODES] * 3, 255))
    u, v, width, height = cv2.boundingRect(cv2.bitwise_not(agree))
    return PixelRect(u, v, u + width, v + height)


def parallax_margin_px(eyes_m: Eyes, stack: PanelStack) -> F64:
    """Return (V, N, 2) shifts, right and down, of rays through the middle panel's centre on each panel,
    in pixels. For rays through other points on the middle panel, they are approximate.
    """
    return _scale_shift_px(eyes_m, stack)[1]


def steepness(codes: U8) -> float:
    """Return how visible phase errors are on 8-bit codes, from 0 (black or white) to 1 (mid-grey). The
    result is the root mean square of the slope of sin², 2·sqrt(I·(1 - I)).
    """
    intensities = codes.astype(np.float64) / 255
    return float(np.sqrt((4 * intensities * (1 - intensities)).mean())) if codes.size else 0.0


def steepness_beside(picture: U8, box: PixelRect) -> float:
    """Return the larger `steepness` left and right of a box, where the outer panels are tapered."""
    rows = slice(box.v0, box.v1, COARSE_STEP)
    beside = (picture[rows, : box.u0 : COARSE_STEP, :3], picture[rows, box.u1 :: COARSE_STEP, :3])
    return max(steepness(side) for side in beside)


def taper_parallaxes(steep: float) -> float:
    """Return the taper width, in parallaxes, for a background whose `steepness` is `steep`."""
    least, most = TAPER_PARALLAXES
    return least + (most - least) * steep


def taper_px(eyes_m: Eyes, stack: PanelStack, *, parallaxes: float) -> tuple[float, float]:
    """Convert a taper's width from parallaxes to pixels (right, down)."""
    across, down = np.ptp(parallax_margin_px(eyes_m, stack), axis=0).max(axis=0) * parallaxes
    return float(across), float(down)


def whole_rays(box: PixelRect, eyes_m: Eyes, stack: PanelStack) -> PixelRect:
    """Return the part of a window, in panel pixels, where rays stay inside it on every panel, except at
    panel edges. The eyes are not relative to the window.
    """
    scale, shift_px = _scale_shift_px(eyes_m, stack)
    limits = []
    for axis, (start, end, whole) in enumerate(((box.u0, box.u1, stack.width_px), (box.v0, box.v1, stack.height_px))):
        low = ((start - whole / 2 - shift_px[..., axis]) / scale).max() + whole / 2 + EDGE_PX
        high = ((end - whole / 2 - shift_px[..., axis]) / scale).min() + whole / 2 - EDGE_PX
        first = int(np.ceil(low)) if start > 0 else 0
        last = int(np.floor(high)) if end < whole else whole
        limits.append((first, max(first, last)))
    (u0, u1), (v0, v1) = limits
    return PixelRect(u0, v0, u1, v1)


def _scale_shift_px(eyes_m: Eyes, stack: PanelStack) -> tuple[F64, F64]:
    """Return scales (V, N) and shifts (V, N, 2) from the centre panel to each along each eye's rays. Pixels are
    measured from the panels' centres, right and down.
    """
    centre = Plane(stack.x_m[stack.count // 2])
    scales, shifts_m = zip(*(centre.scale_shift_to(Plane(x_m), eyes_m) for x_m in stack.x_m), strict=True)
    px_per_m = stack.width_px / stack.width_m, -stack.height_px / stack.height_m
    return np.stack(scales, axis=1), np.stack(shifts_m, axis=1) * px_per_m


def window_around(box: PixelRect, eyes_m: Eyes, stack: PanelStack, *, parallaxes: float) -> PixelRect | None:
    """Return the window, with margins for a taper of `parallaxes`, to solve a box where pictures differ.
    Its sides are rounded up to sixteenths of the panel's.
    """
    scale, shift_px = _scale_shift_px(eyes_m, stack)
    spans: list[tuple[int, int]] = []
    for axis, (start, end, whole) in enumerate(((box.u0, box.u1, stack.width_px), (box.v0, box.v1, stack.height_px))):
        shift, ends = shift_px[..., axis], (start - whole / 2, end - whole / 2)  # relative to the panel's centre
        # At least 0, on the centre panel.
        before, after = (ends[0] - (ends[0] * scale + shift)).max(), (ends[1] * scale + shift - ends[1]).max()
        room = parallaxes * float(np.ptp(shift, axis=0).max()) + MARGIN_PX
        low = max(start - (PANEL_CROSSINGS * float(before) + room), 0.0)
        high = min(end + (PANEL_CROSSINGS * float(after) + room), float(whole))
        step = whole / WINDOW_SHARES
        size = min(int(np.ceil(np.ceil((high - low) / step) * step / 8) * 8), whole)
        first = int(np.clip(np.floor((low + high - size) / 2), 0, whole - size))
        spans.append((first, first + size))
    (u0, u1), (v0, v1) = spans
    too_large = (u1 - u0) * (v1 - v0) > MAX_SHARE * stack.width_px * stack.height_px
    return None if too_large else PixelRect(u0, v0, u1, v1)


def still_fits(held: PixelRect, new: PixelRect) -> bool:
    """Return True if the window `held` contains `new` and is not much larger, so that it can be kept."""
    inside = held.u0 <= new.u0 and held.v0 <= new.v0 and held.u1 >= new.u1 and held.v1 >= new.v1
    return inside and held.width_px * held.height_px <= MAX_SLACK * new.width_px * new.height_px
