"""Reduces a job to the window where the eyes' pictures differ, and to one channel if grey.

Panels that are cut to a window and moved to its centre are a smaller stack, seen by eyes moved the same way. Where the
eyes agree, the outer panels stand at the middle of their range, and the centre panel carries the picture. What drives
the outer panels fades out towards the window's edge (`Geometry.tapers`): there is no seam.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from runtime.model.geometry import geometry_of
from runtime.model.job import Job, Part, Picture
from runtime.model.targets import is_grey
from runtime.model.warp import coarser, reduced_pictures, resample
from runtime.optics.rect import PixelRect, union
from runtime.optics.stack import PanelStack
from runtime.records import F64, U8
from runtime.support.gl import DrawnPicture
from runtime.support.threads import PIECE_ROWS, parallel_map

TOLERANCE_CODES = 2  # eyes that differ by no more agree: a tenth of what 8 bits cost at 40 dB
NOWHERE = PixelRect(0, 0, 0, 0)
COARSE_STEP = 16  # of the look that decides whether a closer one is worth its time
MAX_SHARE = 0.6  # of the panel: a larger window is not worth cutting out
MAX_SLACK = 1.3  # of a kept window's area over the one that would do
STEPS = 16  # windows are whole sixteenths of the panel, so that a few sizes serve all
# Measured with the shipped models: a wave along the line of the eyes that fades out over fourteen parallaxes beside a
# difference costs 0.06 dB before mid-grey, where sin² is steepest, and over six up to 0.4; before white or black,
# where it is level, six cost 0.02. A window must also hold each panel's part of what the eyes see through another.
WAVE_STEPS = (6.0, 14.0)
PANEL_CROSSINGS = 2.0
MARGIN_PX = 16
EDGE_PX = 2
COARSER = 2  # times fewer pixels, either way, on which still pictures are compared


@dataclass(frozen=True, slots=True)
class Scene:
    """What is known of what the pictures show, besides the pictures."""

    stack: PanelStack
    extent: PixelRect | None = None  # centre-panel pixels beside which both eyes see `colour` alone; None: not known
    colour: tuple[int, ...] = (255, 255, 255)  # 8-bit codes
    before: Part | None = None  # of the job before: kept where it will do, so that nothing is allocated again


@dataclass(frozen=True, slots=True)
class Savings:
    """What was left out of a job."""

    solved_share: float = 1.0  # of the panels' pixels
    channels: int = 3


def trim(job: Job, scene: Scene) -> tuple[Job, Savings]:
    """The job with less work, and what that leaves out.

    Called twice a frame: before its pictures are drawn, if the content knows its extent, and after.
    """
    part = job.part
    if part is None and (job.pictures or job.own):
        part = _differing_part(job, scene)
    elif part is None and scene.extent is not None and scene.extent.width_px:
        steep = max(steepness(np.array([code], np.uint8)) for code in scene.colour)
        part = _part_around(scene.extent, job.eyes_m, scene, steep=steep)
        part = part and replace(part, colour=scene.colour, drawn=True)
    grey = False
    if job.own is not None:
        grey = all(map(is_grey, job.own.pictures))
    elif job.pictures and not (part is not None and not part.box.width_px):
        grey = all(_is_grey(images[0], part) for images in job.pictures)
    trimmed = replace(job, part=part, channels=1 if grey else job.channels)
    return trimmed, Savings(trimmed.solved_share(scene.stack), trimmed.channels)


def _differing_part(job: Job, scene: Scene) -> Part | None:
    """Where the pictures differ; None where that is too much, or they were left in textures."""
    if job.own is not None:
        geometry = geometry_of(job, scene.stack)
        raster = coarser(geometry.rasters[geometry.middle], COARSER)
        left, right = (
            np.asarray(
                resample(
                    picture,
                    from_plane @ raster.plane_from_raster(),
                    size=(raster.height_px, raster.width_px),
                    edge=cv2.BORDER_REPLICATE,
                )
            )
            for picture, from_plane in reduced_pictures(replace(job, channels=3), geometry, COARSER)
        )
        begin, scale = geometry.boxes[geometry.middle], COARSER
    else:
        left, right = (images[0] for images in job.pictures)  # type: ignore[assignment]
        begin, scale = PixelRect(0, 0, 0, 0), 1
        if isinstance(left, DrawnPicture) or isinstance(right, DrawnPicture):
            return None

    def part_of(box: PixelRect) -> Part | None:
        grown = PixelRect(*(begin_px + scale * at for begin_px, at in zip((begin.u0, begin.v0) * 2, box.corners)))
        return _part_around(grown, job.eyes_m, scene, steep=steepness_beside(left, box))

    # A coarse look tells for next to nothing what is too large; only the rest is worth a close one.
    box, part = coarse_box(left, right), None
    if box.width_px:
        part = part_of(box)
    if not box.width_px or part is not None:
        box = differing_box(left, right, known=box)
        part = part_of(box) if box.width_px else Part(NOWHERE, NOWHERE, (0.0, 0.0))
    return part


def _part_around(box: PixelRect, eyes_m: F64, scene: Scene, *, steep: float) -> Part | None:
    """What is solved for a box in which the eyes' pictures differ; None where that is as good as all."""
    stack, steps = scene.stack, wave_steps(steep)
    window = window_around(box, eyes_m, stack, steps=steps)
    if window is None:
        return None
    if scene.before is not None and still_fits(scene.before.box, window):
        window = scene.before.box
    # Near the window's edge the centre panel can't know what rays meet that leave the window.
    return Part(window, whole_rays(window, eyes_m, stack), wave_px(eyes_m, stack, steps=steps))


def _is_grey(picture: Picture, part: Part | None) -> bool:
    """Whether there is no colour in what is solved; as far as it is told, where that was left in a texture."""
    if isinstance(picture, DrawnPicture):
        return picture.grey
    return is_grey(picture if part is None or part.drawn else picture[part.box.slices])


def differing_box(left: U8, right: U8, *, tolerance: int = TOLERANCE_CODES, known: PixelRect = NOWHERE) -> PixelRect:
    """The smallest box in which two (h, w, 3 or 4) pictures differ; empty where they agree.

    known: a box within it, as `coarse_box` finds one: only what is beside that is looked at.
    """
    height, width = left.shape[:2]

    def look(part: PixelRect) -> PixelRect:
        found = _box(left[part.slices], right[part.slices], tolerance)
        return PixelRect(found.u0 + part.u0, found.v0 + part.v0, found.u1 + part.u0, found.v1 + part.v0)

    parts = known.beside(width_px=width, height_px=height)
    return union([known, *parallel_map(look, [piece for part in parts for piece in part.in_rows(PIECE_ROWS)])])


def coarse_box(left: U8, right: U8, *, tolerance: int = TOLERANCE_CODES) -> PixelRect:
    """A box within `differing_box` from a few pixels, at a hundredth of the time.

    It decides whether the window would be too much of the panel to be worth cutting out.
    """
    few = [np.ascontiguousarray(picture[::COARSE_STEP, ::COARSE_STEP]) for picture in (left, right)]
    box = _box(few[0], few[1], tolerance)
    if not box.width_px:
        return box
    return PixelRect(
        box.u0 * COARSE_STEP,
        box.v0 * COARSE_STEP,
        (box.u1 - 1) * COARSE_STEP + 1,
        (box.v1 - 1) * COARSE_STEP + 1,
    )


def _box(left: U8, right: U8, tolerance: int) -> PixelRect:
    difference = cv2.absdiff(left, right)
    agree = cv2.inRange(difference, (0, 0, 0, 0), (tolerance, tolerance, tolerance, 255))
    u, v, width, height = cv2.boundingRect(cv2.bitwise_not(agree))
    return PixelRect(u, v, u + width, v + height)


def parallax_margin_px(eyes_m: F64, stack: PanelStack) -> F64:
    """(2, N, 2) stray on each panel of rays through a centre-panel pixel: columns right, rows down.

    To first order, as at the window's centre. eyes_m: (2, 3) left, right; frame `stack`.
    """
    middle = stack.x_m[stack.count // 2]
    gaps_m = np.array(stack.x_m) - middle
    per_metre = np.array([stack.width_px / stack.width_m, -stack.height_px / stack.height_m])
    parallax: F64 = eyes_m[:, None, 1:] * (gaps_m[None, :, None] / (eyes_m[:, None, :1] - middle)) * per_metre
    return parallax


def steepness(codes: U8) -> float:
    """Visibility of a phase error before these 8-bit codes: 0 at black or white, 1 at mid-grey.

    The slope of sin² in its own terms, 2·sqrt(I·(1 - I)), root mean square.
    """
    intensities = codes.astype(np.float64) / 255
    return float(np.sqrt((4 * intensities * (1 - intensities)).mean())) if codes.size else 0.0


def steepness_beside(picture: U8, box: PixelRect) -> float:
    """The same of what lies right and left of a box in an (h, w, 4) picture: there a wave must fade."""
    rows = slice(box.v0, box.v1, COARSE_STEP)
    beside = (picture[rows, : box.u0 : COARSE_STEP, :3], picture[rows, box.u1 :: COARSE_STEP, :3])
    return max(steepness(side) for side in beside)


def wave_steps(steep: float) -> float:
    """Parallaxes that outer panels are driven beside a difference, by the background's steepness."""
    least, most = WAVE_STEPS
    return least + (most - least) * steep


def wave_px(eyes_m: F64, stack: PanelStack, *, steps: float) -> tuple[float, float]:
    """The same in pixels, right and down. eyes_m: (2, 3), frame `stack`."""
    left, right = parallax_margin_px(eyes_m, stack)
    across, down = np.abs(left - right).max(axis=0) * steps
    return float(across), float(down)


def room_px(low: float, high: float, parallax: F64, *, eyes_px: F64, weights: F64, steps: float) -> tuple[float, float]:
    """Along one axis: margins before and after a difference from `low` to `high`.

    Pixels from the centre of the panel. parallax: (2, N), one axis of `parallax_margin_px`; eyes_px: (2,) the eyes'
    places on this axis; weights: (2, N) how far along its ray from the centre panel to the eye each panel lies; steps:
    as `wave_steps` has it.
    """
    before = (weights * (low - eyes_px[:, None])).max()
    after = (weights * (eyes_px[:, None] - high)).max()
    room = steps * float(np.abs(parallax[0] - parallax[1]).max()) + MARGIN_PX
    return PANEL_CROSSINGS * max(float(before), 0.0) + room, PANEL_CROSSINGS * max(float(after), 0.0) + room


def whole_rays(box: PixelRect, eyes_m: F64, stack: PanelStack) -> PixelRect:
    """The part of a window in which no eye's ray leaves it on another panel; up to the panels' own edges.

    A ray through p on the centre panel meets a panel of weight t at p(1 - t) + e·t. eyes_m: (2, 3), frame
    `stack`, not moved to the window.
    """
    weights = _weights(eyes_m, stack)
    limits = []
    for axis, (start, end, whole) in enumerate(((box.u0, box.u1, stack.width_px), (box.v0, box.v1, stack.height_px))):
        along = _eyes_px(eyes_m, stack)[:, axis, None] * weights
        low = ((start - whole / 2 - along) / (1 - weights)).max() + whole / 2 + EDGE_PX
        high = ((end - whole / 2 - along) / (1 - weights)).min() + whole / 2 - EDGE_PX
        first = max(int(np.ceil(low)), start) if start > 0 else 0
        last = min(int(np.floor(high)), end) if end < whole else whole
        limits.append((first, max(first, last)))
    (u0, u1), (v0, v1) = limits
    return PixelRect(u0, v0, u1, v1)


def _weights(eyes_m: F64, stack: PanelStack) -> F64:
    """(2, N): how far along its ray from the centre panel to an eye each panel lies; 1 is the eye."""
    middle = stack.x_m[stack.count // 2]
    weights: F64 = (np.array(stack.x_m) - middle)[None] / (eyes_m[:, :1] - middle)
    return weights


def _eyes_px(eyes_m: F64, stack: PanelStack) -> F64:
    """(2, 2): the eyes' places in panel pixels from the panel's centre, columns and rows."""
    places: F64 = eyes_m[:, 1:] * np.array([stack.width_px / stack.width_m, -stack.height_px / stack.height_m])
    return places


def window_around(box: PixelRect, eyes_m: F64, stack: PanelStack, *, steps: float) -> PixelRect | None:
    """The window of a difference: grown by its margins, rounded up to sixteenths of the panel.

    steps: as `wave_steps` has it. None where it would be most of the panel: then the whole is as fast.
    """
    parallax, weights, eyes_px = parallax_margin_px(eyes_m, stack), _weights(eyes_m, stack), _eyes_px(eyes_m, stack)
    spans: list[tuple[int, int]] = []
    for axis, (start, end, whole) in enumerate(((box.u0, box.u1, stack.width_px), (box.v0, box.v1, stack.height_px))):
        before, after = room_px(
            start - whole / 2,
            end - whole / 2,
            parallax[..., axis],
            eyes_px=eyes_px[:, axis],
            weights=weights,
            steps=steps,
        )
        low, high = max(start - before, 0.0), min(end + after, float(whole))
        step = whole / STEPS
        size = min(int(np.ceil(np.ceil((high - low) / step) * step / 8) * 8), whole)
        first = int(np.clip(np.floor((low + high - size) / 2), 0, whole - size))
        spans.append((first, first + size))
    (u0, u1), (v0, v1) = spans
    if (u1 - u0) * (v1 - v0) > MAX_SHARE * stack.width_px * stack.height_px:
        return None
    return PixelRect(u0, v0, u1, v1)


def still_fits(held: PixelRect, new: PixelRect) -> bool:
    """True where a window in use holds a new one and isn't much larger: nothing need be allocated again."""
    inside = held.u0 <= new.u0 and held.v0 <= new.v0 and held.u1 >= new.u1 and held.v1 >= new.v1
    return inside and held.width_px * held.height_px <= MAX_SLACK * new.width_px * new.height_px
