"""Measure each solution's error, lost detail and rate of change, on the solver's thread."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.clock import NS_PER_S
from runtime.frame.served import moved_m2
from runtime.model.geometry import TargetView
from runtime.model.job import Job
from runtime.model.solver import REDUCTIONS
from runtime.optics.alignment import common_movement_m
from runtime.optics.light import panels_from_centre
from runtime.optics.presentation import displacement
from runtime.optics.relief import parallax
from runtime.optics.retina import through_layers
from runtime.optics.stack import PanelStack
from runtime.records import F32, F64, U8, Effort, Eyes, Measures
from runtime.support.gl import DrawnPicture

RAYS = 1024  # rays per eye
SAMPLED = 54, 96  # rows and columns of the grid used to compare successive pictures
BAND_ROWS = 64  # height of each of the two bands used to measure lost detail
EVERY = 4  # measure residual and detail on every 4th solution with the same effort, and change on every 4th of all


class SolutionMeter:
    """Measures each solution's errors and how much its pictures differ from the previous solution's."""

    def __init__(self) -> None:
        self._before: tuple[tuple[int, ...], list[U8], Job, int] | None = None  # raster and window, pictures, job, time
        self._counts: dict[Effort, int] = {}
        self._solutions = 0
        self._places = np.random.default_rng(1).random((2, RAYS, 2))

    def measure(self, job: Job, layers: U8, effort: Effort, *, time_ns: int) -> Measures | None:
        """Measure one solution's layers, drawn for `time_ns`, or return None if its pictures are textures."""
        if any(isinstance(view.picture, DrawnPicture) for view in job.views):
            return None
        key = Effort(effort.reduction, effort.steps)
        count = self._counts.get(key, 0)
        self._counts[key] = count + 1
        change = self._change(job, time_ns=time_ns)
        if count % EVERY:
            return Measures(change=change)
        samples = [_grid(_halved(view.pixels)) for view in job.views]
        return Measures(
            residual=sampled_light(layers, job, self._places, boxes=effort.reduction == 1),
            detail=lost_detail(job.views[0].pixels) if effort.reduction == 1 else {},
            contrast=float(np.mean([sample.var(axis=(0, 1)) for sample in samples])) / 2,
            change=change,
        )

    def _change(self, job: Job, *, time_ns: int) -> tuple[float, float, float] | None:
        """Return `Measures.change`, or None if it is not measured for this solution. Of every `EVERY` solutions, one
        has its pictures copied and compared with the next solution's pictures.
        """
        turn, self._solutions = self._solutions % EVERY, self._solutions + 1
        before, self._before = self._before, None
        if turn > 1 or (turn == 1 and before is None):
            return None
        box = () if job.window is None else job.window.box.corners
        raster = (job.stack.width_px, job.stack.height_px, *box)
        if turn == 0:
            self._before = raster, [_halved(view.pixels) for view in job.views], job, time_ns
            return None
        assert before is not None
        before_raster, earlier, solved, earlier_ns = before
        if before_raster != raster or solved.eyes_m.shape != job.eyes_m.shape:
            return None
        samples = [_grid(_halved(view.pixels)) for view in job.views]
        moved_m = moved_m2(solved.eyes_m, job.eyes_m) ** 0.5
        shown = _moved_grid(earlier, solved, job.eyes_m)
        changed = float(np.mean([((new - old) ** 2).mean() for new, old in zip(samples, shown, strict=True)]))
        return changed, moved_m, abs(time_ns - earlier_ns) / NS_PER_S


def sampled_light(layers: U8, job: Job, places: F64, *, boxes: bool) -> float | None:
    """Return the squared error of the light, measured at sampled pixels in both pictures.

    Two rays are traced through each sampled pixel, and their errors are multiplied, so that the mean is unbiased
    (docs/contracts.md: light). A pair is ignored if either ray misses a panel; None if no pair is left.

    `places` are uniform numbers in [0, 1), shape (2, K, 2): `places[0]` selects the K pixels, as fractions of the
    picture's size, and all remainders modulo 1/64 the rays' positions within their pixel. Panel pixels are squares if
    `boxes`, or else, in a coarse solution, enlarged bilinearly.
    """
    eyes = zip(job.eyes_m, job.views, strict=True)
    product = np.concatenate([_products(layers, job.stack, eye_m, view, places, boxes=boxes) for eye_m, view in eyes])
    return max(float(product.mean()), 0.0) if product.size else None


def _products(
    layers: U8, stack: PanelStack, eye_m: F64, view: TargetView, places: F64, *, boxes: bool
) -> NDArray[np.floating[Any]]:
    """Return the (K', 3) products of errors at those pixels in an eye's picture whose two rays cross all panels."""
    height, width = view.picture.shape[:2]
    column, row = (places[0] * (width, height)).astype(int).T
    target = view.pixels[row, column, :3] / np.float32(255)
    offset = (places % (1 / 64) * 64).reshape(-1, 2).T  # position within the pixel, whichever was chosen
    u, v = (np.tile((column, row), 2) + offset)[:, None]
    middle_from_picture = stack.panel(stack.count // 2).raster_from_plane() @ view.plane_from_picture
    matrices = panels_from_centre(eye_m, stack) @ middle_from_picture
    seen = through_layers(layers, matrices, u, v, np.ones(u.shape, bool), boxes=boxes)
    first, second = np.split(seen.image[0] - np.tile(target, (2, 1)), 2)
    return np.asarray((first * second)[np.logical_and(*np.split(seen.mask[0], 2))])


def lost_detail(picture: U8) -> Mapping[int, float]:
    """Return the squared error due to reducing and re-enlarging a picture (h, w, 3 or 4), by reduction."""
    height = picture.shape[0]
    bands = [picture[first : first + BAND_ROWS, :, :3] for first in (height // 3, 2 * height // 3)]
    return {
        reduction: float(np.mean([_lost(band, reduction) for band in bands]))
        for reduction in REDUCTIONS
        if reduction > 1
    }


def _lost(band: U8, reduction: int) -> float:
    size = max(1, band.shape[1] // reduction), max(1, band.shape[0] // reduction)
    coarse = cv2.resize(band, size, interpolation=cv2.INTER_AREA)
    enlarged = cv2.resize(coarse, band.shape[1::-1], interpolation=cv2.INTER_LINEAR)
    return cv2.norm(band, enlarged, cv2.NORM_L2SQR) / (band.size * 255.0**2)


def _halved(picture: U8) -> U8:
    """Average blocks of 2 x 2 pixels, so that interpolation affects the comparison less."""
    height, width = picture.shape[:2]
    if min(height, width) < 2:
        return picture.copy()
    even = picture[: height // 2 * 2, : width // 2 * 2]
    return np.asarray(cv2.resize(even, (width // 2, height // 2), interpolation=cv2.INTER_AREA), np.uint8)


def _grid(picture: U8) -> F32:
    """Sample a picture on the coarse `SAMPLED` grid. Returns values in 0..1, shape (rows, columns, 3)."""
    rows, columns = _grid_lines(picture)
    return np.asarray(picture[rows][:, columns, :3] / np.float32(255), np.float32)


def _grid_lines(picture: U8) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    rows, columns = (np.linspace(0, n - 1, min(n, k)).astype(int) for n, k in zip(picture.shape, SAMPLED, strict=False))
    return rows, columns


def _moved_grid(pictures: Sequence[U8], job: Job, eyes_m: Eyes) -> list[F32]:
    """Sample pictures at half size (`_halved`) on the coarse grid, as the panels would show them to the moved eyes."""
    stack = job.stack
    old_m = job.eyes_m.mean(axis=0)
    moved = parallax(stack, old_m=old_m, new_m=old_m + common_movement_m(job.eyes_m, eyes_m))
    if moved is None or job.relief is None:
        return [_grid(picture) for picture in pictures]
    rows, columns = _grid_lines(pictures[0])
    u0, v0 = (0, 0) if job.window is None else (job.window.box.u0, job.window.box.v0)
    u, v = 2 * columns[None] + (u0 + 1.0), 2 * rows[:, None] + (v0 + 1.0)  # middles of 2 x 2 of the raster's pixels
    right, down = displacement(moved, stack.count // 2, job.relief, (stack.width_px, stack.height_px), u, v)
    u, v = (columns + right / 2).astype(np.float32), (rows[:, None] + down / 2).astype(np.float32)
    warped = [cv2.remap(picture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for picture in pictures]
    return [np.asarray(picture[..., :3] / np.float32(255), np.float32) for picture in warped]
