"""A network's proposals for the outer panels, which the solver's steps start from.

The network gets the difference between the eyes' pictures on a special raster (`chain`). Its rows are parallel to
the line through the eyes, and the parallax is a whole number of columns. The network returns both outer panels on the
same raster.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.clock import Stopwatch
from runtime.errors import EyesNotServed, ModelFailure
from runtime.kernels import FULL
from runtime.model.chain import ChainFrame, ColumnLaw, cell_waves, chain_frame, chain_modes
from runtime.model.geometry import Geometry, TargetView, taper
from runtime.model.job import Job
from runtime.model.session import ModelSession
from runtime.model.targets import phase_codes, rest_of, without_alpha
from runtime.model.warp import REACH_PX, warp
from runtime.optics.stack import PanelStack, PlaneRaster
from runtime.optics.tilt import coarse_layer_from_seen
from runtime.records import F32, F64, I16, Eyes
from runtime.support.threads import parallel_map

INPUTS = (
    "left",
    "right",
    "waves",
    "shifted_waves",
    "spectrum",
    "modes_in",
    "cell_waves",
    "cell_frequencies",
    "eye_sigma_px",
)
HALF_BASELINE_M = 0.031  # half the eye separation assumed if one eye replaces the other; any value works
EDGE_SHARE = 1 / 40  # a picture's edge pixels are repeated outwards by at most this share of its size
UNSEEN = -1  # value of pixels not seen by an eye; targets are never negative
SHARPENED = 0.2  # gain of a sharpening filter that compensates for the blur caused by two interpolations
SHARPENING = np.array([-SHARPENED, 1 + 2 * SHARPENED, -SHARPENED])
EVEN = rest_of(3)  # an outer panel's rest value in sixteenths of a code
# A transposed raster samples the pictures less accurately, so its stretch must be below this share of the upright
# one's.
TRANSPOSED_BELOW = 0.7
_SWAPPED = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # swaps (y, z, 1) with (-z, -y, 1)


class Proposal(Protocol):
    """Network that proposes panel values for the solver's steps to start from."""

    any_raster: bool  # True if the network can propose panels of any size, and windows
    session: ModelSession

    def panels(self, job: Job, geometry: Geometry, watch: Stopwatch) -> dict[int, I16]:
        """Return the values (rows, columns[, 3]) proposed for panels' boxes, in sixteenths of a code; other
        panels rest. Times are added to `watch` as "prepare" and "inference". Raises ModelFailure and EyesNotServed as
        `Predictor.solve`.
        """


@dataclass(frozen=True, slots=True)
class _Local:
    """A window of the panels as a separate stack, possibly transposed to make the eyes roughly level."""

    stack: PanelStack
    eyes_m: Eyes  # (2, 3) eyes in the window's frame; the first eye is on the left in this frame
    order: tuple[int, int]  # indices of these eyes in the job
    plane_from_local: F64  # 3x3 map from (y, z, 1) in the window's frame to (y, z, 1) in frame `stack`

    def in_stack(self, point_m: F64) -> F64:
        """Convert a (3,) point from the window's frame to frame `stack`."""
        y_m, z_m, _ = self.plane_from_local @ (point_m[1], point_m[2], 1.0)
        return np.array([point_m[0], y_m, z_m])


class ChainProposal:
    """Proposals made by a network whose `input_frame` is `chain`, for three panels with similar gaps."""

    any_raster = True

    def __init__(self, session: ModelSession) -> None:
        self.session = session
        self._cell_px, self._reduction = session.contract.cell_px, session.contract.reduction
        codes = phase_codes(session.contract.branch)
        self._codes = codes - codes.min()

    def panels(self, job: Job, geometry: Geometry, watch: Stopwatch) -> dict[int, I16]:
        try:
            local, frame = _with_raster(
                geometry, whole=job.window is None, most_cell_px=self._cell_px, reduction=self._reduction
            )
        except ValueError as error:
            raise EyesNotServed(str(error)) from None
        middle_x_m = geometry.rasters[geometry.middle].x_m
        pictures = parallel_map(
            lambda view: self._target_codes(view, job.channels), job.targets.reduced(self._reduction)[:2]
        )

        def residual(side: int) -> I16:
            """Return half the difference between the eyes' targets, along the rays from eye `side`."""
            to_plane = local.plane_from_local @ frame.plane_from_frame(local.eyes_m[side], x_m=middle_x_m)
            own, other = (
                warp(
                    codes, from_plane @ to_plane, size=(frame.rows, frame.width_px), outside=UNSEEN,
                    reach_px=min(REACH_PX, EDGE_SHARE * min(codes.shape[:2])), result_columns=frame.columns, threads=1,
                )
                for codes, from_plane in (pictures[local.order[side]], pictures[local.order[1 - side]])
            )  # fmt: skip
            return _residual(own, other)

        # Give each eye a single thread, because passing small operations between threads would take longer.
        left, right = parallel_map(residual, (0, 1))
        waves, shifted_waves, spectrum, modes_in = chain_modes(frame.cells)
        cell, cell_frequencies = cell_waves(frame.cell_px)
        feeds: dict[str, NDArray[Any]] = {
            "left": left.reshape(frame.rows, frame.cells, -1),
            "right": right.reshape(frame.rows, frame.cells, -1),
            "waves": waves,
            "shifted_waves": shifted_waves,
            "spectrum": spectrum,
            "modes_in": modes_in,
            "cell_waves": cell,
            "cell_frequencies": cell_frequencies,
            "eye_sigma_px": frame.eye_sigma_px(local.stack, eye_sigma_m=job.eye_sigma_m, cell_px=self._cell_px),
        }
        shape = (frame.rows, frame.cells + 1, feeds["left"].shape[2])
        watch.lap("prepare")
        answer = self.session.run(feeds, {"rear": shape, "front": shape, "check": (1,)})
        if not np.isfinite(answer["check"]).all():
            raise ModelFailure("the network's output contains values that are not finite")
        watch.lap("inference")
        outer = {n: answer[name].reshape(frame.rows, -1, *left.shape[2:]) for n, name in ((0, "rear"), (2, "front"))}
        panels = parallel_map(lambda item: self._on_panel(*item, geometry, local, frame), list(outer.items()))
        return dict(zip(outer, panels, strict=True))

    def _target_codes(self, view: TargetView, channels: int) -> tuple[I16, F64]:
        """Return the target sum of panel values for each pixel in a view, and the view's inverse homography. The sums
        are in sixteenths of a code and may differ from the true sums by a constant. The 3x3 inverse homography maps
        points (y, z, 1) on the middle panel's plane to view pixels.
        """
        codes = cv2.LUT(without_alpha(view.pixels, channels), self._codes)
        return np.asarray(codes, np.int16), np.asarray(np.linalg.inv(view.plane_from_picture), np.float64)

    def _on_panel(self, n: int, answer: I16, geometry: Geometry, local: _Local, frame: ChainFrame) -> I16:
        """Resample the network's output to the box of outer panel `n`."""
        raster = geometry.rasters[n]
        middle_m = local.in_stack(frame.middle_m)
        seen_from_layer = np.linalg.inv(coarse_layer_from_seen(geometry.stack, n, middle_m))
        to_frame = frame.frame_from_plane(x_m=raster.x_m) @ np.linalg.inv(local.plane_from_local)
        # The output begins `cell_px` columns (one parallax) before the raster's first column.
        begin = np.array([[1.0, 0.0, frame.cell_px], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
        columns = ColumnLaw(frame.columns.bend, frame.columns.middle + frame.cell_px)
        matrix = begin @ to_frame @ seen_from_layer @ raster.plane_from_raster()
        size = raster.height_px, raster.width_px
        codes = warp(np.clip(answer, 0, FULL), matrix, size=size, outside=EVEN, image_columns=columns, threads=1)
        return tapered(codes, n, geometry, middle_m=middle_m)


def tapered(codes: I16, n: int, geometry: Geometry, *, middle_m: F64 | None = None) -> I16:
    """Fade the values (rows, columns[, 3]) of an outer panel's box to the rest value at the edges of the
    window. The window is projected from `middle_m`, by default the middle of the eyes.
    """
    if max(geometry.taper_px) <= 0 or n == geometry.middle:
        return codes
    at_m = geometry.eyes_m.mean(axis=0) if middle_m is None else middle_m
    weights = _wave_taper(geometry, geometry.rasters[n], at_m)
    weights = weights[..., None] if codes.ndim == 3 else weights
    even = rest_of(geometry.stack.count)
    return np.asarray(np.rint(even + (codes - np.float32(even)) * weights), np.int16)


def _residual(own: I16, other: I16) -> I16:
    """Return half the difference between two eyes' targets, sharpened, from 0 where one sees nothing (`UNSEEN`)."""
    half = np.asarray(cv2.subtract(own, other), np.int16) >> 1
    # Rays outside one eye's picture have no residual.
    np.copyto(half, 0, where=cv2.min(own, other) < 0)
    return np.asarray(cv2.sepFilter2D(half, cv2.CV_16S, SHARPENING, SHARPENING), np.int16)


def _with_raster(geometry: Geometry, *, whole: bool, most_cell_px: int, reduction: int) -> tuple[_Local, ChainFrame]:
    """Return the panels, all or the window's, and their raster, transposed if this makes it considerably less tall.
    Raises ValueError if `chain_frame` refuses the eyes in both orientations.
    """
    choices: list[tuple[float, _Local, ChainFrame]] = []
    refusals: list[ValueError] = []
    upright = _local(geometry, whole=whole)
    for local, weight in ((upright, TRANSPOSED_BELOW), (_transposed(upright), 1.0)):
        try:
            frame = chain_frame(local.eyes_m, local.stack, most_cell_px=most_cell_px, reduction=reduction)
            choices.append((frame.stretch * weight, local, frame))
        except ValueError as error:
            refusals.append(error)
    if not choices:
        raise refusals[0]
    _, local, frame = min(choices, key=lambda choice: choice[0])
    return local, frame


def _local(geometry: Geometry, *, whole: bool) -> _Local:
    """Return the whole panels or the window as a separate stack."""
    stack, eyes_m, box = geometry.stack, geometry.eyes_m, geometry.boxes[geometry.middle]
    plane_from_local = np.eye(3)
    if not whole:
        pitch_m = np.array([stack.width_m / stack.width_px, stack.height_m / stack.height_px])
        y_m = ((box.u0 + box.u1 - stack.width_px) / 2) * pitch_m[0]
        z_m = ((stack.height_px - box.v0 - box.v1) / 2) * pitch_m[1]
        across_m, down_m = box.width_px * pitch_m[0], box.height_px * pitch_m[1]
        stack = PanelStack(float(across_m), float(down_m), stack.x_m, box.width_px, box.height_px)
        eyes_m = eyes_m - np.array([0.0, y_m, z_m])
        plane_from_local = np.array([[1.0, 0.0, y_m], [0.0, 1.0, z_m], [0.0, 0.0, 1.0]])
    if np.array_equal(eyes_m[0], eyes_m[1]):  # one eye replaces the other: any line is suitable
        eyes_m = eyes_m + HALF_BASELINE_M * np.array([[0.0, -1.0, 0.0], [0.0, 1.0, 0.0]])
    return _Local(stack, *_left_first(eyes_m), plane_from_local)


def _transposed(local: _Local) -> _Local:
    """Return the same stack with down (-z) turned into right (+y)."""
    eyes_m = local.eyes_m[list(local.order)]
    eyes_m, order = _left_first(np.stack([eyes_m[:, 0], -eyes_m[:, 2], -eyes_m[:, 1]], axis=1))
    stack = replace(local.stack, tilt=None).transposed()
    return _Local(stack, eyes_m, order, local.plane_from_local @ _SWAPPED)


def _left_first(eyes_m: Eyes) -> tuple[F64, tuple[int, int]]:
    """Return the (2, 3) eyes ordered from left to right, and their indices."""
    order = (0, 1) if eyes_m[1, 1] >= eyes_m[0, 1] else (1, 0)
    return eyes_m[list(order)], order


def _wave_taper(geometry: Geometry, raster: PlaneRaster, middle_m: F64) -> F32:
    """Return weights (rows, columns) of an outer panel's box: 1 inside the window, falling to 0 at its edges. Positions
    are projected to the centre panel along rays from `middle_m`, the point between the eyes.
    """
    stack, kept = geometry.stack, geometry.kept
    to_centre = raster.to(stack.panel(stack.count // 2), middle_m)
    u = to_centre[0, 0] * (np.arange(raster.width_px) + 0.5) + to_centre[0, 2]
    v = to_centre[1, 1] * (np.arange(raster.height_px) + 0.5) + to_centre[1, 2]
    across = taper(u, kept.u0, kept.u1, stack.width_px, geometry.taper_px[0])
    down = taper(v, kept.v0, kept.v1, stack.height_px, geometry.taper_px[1])
    return np.asarray(across * down[:, None], np.float32)
