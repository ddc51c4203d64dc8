"""Proposals by a network for the outer panels, from which the steps begin.

The network receives the difference of both eyes' pictures on a separate raster (`chain`) along the line through the
eyes, where an eye's parallax is a whole number of columns. It returns both outer panels on that raster.
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
from runtime.model.chain import ChainFrame, ColumnLaw, chain_frame, chain_modes
from runtime.model.geometry import Geometry, TargetView, taper
from runtime.model.job import Job
from runtime.model.session import ModelSession
from runtime.model.targets import phase_codes, rest_of, without_alpha
from runtime.model.warp import REACH_PX, warp
from runtime.optics.stack import PanelStack, PlaneRaster
from runtime.optics.tilt import coarse_layer_from_seen
from runtime.records import F32, F64, I16
from runtime.support.threads import parallel_map

HALF_BASELINE_M = 0.031  # assumed if a single eye stands in for both; any value works
EDGE_SHARE = 1 / 40  # a picture's edge pixels are repeated outwards by at most this share of its size
UNSEEN = -1  # marks pixels that an eye does not see; targets are positive
SHARPENED = 0.2  # gain by which the difference is sharpened on either side, against the blur of two interpolations
SHARPENING = np.array([-SHARPENED, 1 + 2 * SHARPENED, -SHARPENED])
EVEN = rest_of(3)  # an outer panel at rest, sixteenths of a code
_SWAPPED = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # (y, z, 1) from (-z, -y, 1), and back


class Proposal(Protocol):
    """A network that proposes the panels from which the steps begin."""

    any_raster: bool  # can propose panels of any size, and windows of them
    session: ModelSession

    def panels(self, job: Job, geometry: Geometry, watch: Stopwatch) -> dict[int, I16]:
        """Return the box (rows, columns[, 3]) of each proposed panel, in sixteenths of a code, by panel.

        Panels that are missing stay at rest. Raises ModelFailure or its subclass EyesNotServed.
        """


@dataclass(frozen=True, slots=True)
class _Local:
    """A window of the panels as a separate stack, rotated so that the eyes are roughly level."""

    stack: PanelStack
    eyes_m: F64  # (2, 3), the eye on the left of this stack first
    order: tuple[int, int]  # indices of these eyes in the whole stack
    plane_from_local: F64  # 3x3, (y, z, 1) of frame `stack` from this stack's

    def in_stack(self, point_m: F64) -> F64:
        """Convert a point (3,) of this stack to frame `stack`."""
        y_m, z_m, _ = self.plane_from_local @ (point_m[1], point_m[2], 1.0)
        return np.array([point_m[0], y_m, z_m])


class ChainProposal:
    """Proposals by a network whose `input_frame` is `chain`, for three (nearly) evenly spaced panels."""

    any_raster = True

    def __init__(self, session: ModelSession) -> None:
        self.session = session
        self._cell_px, self._reduction = session.contract.cell_px, session.contract.reduction
        codes = phase_codes(session.contract.branch)
        self._codes = codes - codes.min()

    def panels(self, job: Job, geometry: Geometry, watch: Stopwatch) -> dict[int, I16]:
        local = _local(geometry, whole=job.window is None)
        try:
            frame = chain_frame(local.eyes_m, local.stack, cell_px=self._cell_px, reduction=self._reduction)
        except ValueError as error:
            raise EyesNotServed(str(error)) from None
        middle_x_m = geometry.rasters[geometry.middle].x_m
        pictures = parallel_map(
            lambda view: self._target_codes(view, job.channels), job.targets.reduced(self._reduction)
        )

        def residual(side: int) -> I16:
            """Return half of an eye's targets minus the other eye's, on the first eye's rays."""
            to_plane = local.plane_from_local @ frame.plane_from_frame(local.eyes_m[side], x_m=middle_x_m)
            own, other = (
                warp(
                    codes, from_plane @ to_plane, size=(frame.rows, frame.width_px), outside=UNSEEN,
                    reach_px=min(REACH_PX, EDGE_SHARE * min(codes.shape[:2])), result_columns=frame.columns, threads=1,
                )
                for codes, from_plane in (pictures[local.order[side]], pictures[local.order[1 - side]])
            )  # fmt: skip
            return _residual(own, other)

        # One thread does all the work for an eye: handing over single operations would take longer than small ones do.
        left, right = parallel_map(residual, (0, 1))
        waves, shifted_waves, spectrum, modes_in = chain_modes(frame.cells)
        feeds: dict[str, NDArray[Any]] = {
            "left": left.reshape(frame.rows, frame.cells, -1),
            "right": right.reshape(frame.rows, frame.cells, -1),
            "waves": waves,
            "shifted_waves": shifted_waves,
            "spectrum": spectrum,
            "modes_in": modes_in,
            "eye_sigma_px": frame.eye_sigma_px(local.stack, eye_sigma_m=job.eye_sigma_m),
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
        """Return each pixel's target sum and the view's 3x3 map to pixels from the middle panel's plane.

        Sums are in sixteenths of a code, up to a constant.
        """
        codes = cv2.LUT(without_alpha(view.pixels, channels), self._codes)
        return np.asarray(codes, np.int16), np.asarray(np.linalg.inv(view.plane_from_picture), np.float64)

    def _on_panel(self, n: int, answer: I16, geometry: Geometry, local: _Local, frame: ChainFrame) -> I16:
        """Resample the network's output to the box of outer panel `n`."""
        raster = geometry.rasters[n]
        middle_m = local.in_stack(frame.middle_m)
        seen_from_layer = np.linalg.inv(coarse_layer_from_seen(geometry.stack, n, middle_m))
        to_frame = frame.frame_from_plane(x_m=raster.x_m) @ np.linalg.inv(local.plane_from_local)
        # The output begins one parallax before the raster's first column.
        begin = np.array([[1.0, 0.0, frame.cell_px], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
        columns = ColumnLaw(frame.columns.bend, frame.columns.middle + frame.cell_px)
        matrix = begin @ to_frame @ seen_from_layer @ raster.plane_from_raster()
        size = raster.height_px, raster.width_px
        codes = warp(np.clip(answer, 0, FULL), matrix, size=size, outside=EVEN, image_columns=columns, threads=1)
        if max(geometry.taper_px) > 0:
            weights = _wave_taper(geometry, raster, middle_m)
            weights = weights[..., None] if codes.ndim == 3 else weights
            codes = np.rint(EVEN + (codes - np.float32(EVEN)) * weights).astype(np.int16)
        return codes


def _residual(own: I16, other: I16) -> I16:
    """Return half of an eye's target minus the other eye's, sharpened."""
    half = np.asarray(cv2.subtract(own, other), np.int16) >> 1
    # Rays outside one eye's picture have no residual.
    np.copyto(half, 0, where=cv2.min(own, other) < 0)
    return np.asarray(cv2.sepFilter2D(half, cv2.CV_16S, SHARPENING, SHARPENING), np.int16)


def _local(geometry: Geometry, *, whole: bool) -> _Local:
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
    apart_m = np.abs(eyes_m[1] - eyes_m[0])
    if apart_m[2] > apart_m[1]:  # if one eye is above the other, down (-z) becomes right (+y)
        eyes_m = np.stack([eyes_m[:, 0], -eyes_m[:, 2], -eyes_m[:, 1]], axis=1)
        stack, plane_from_local = replace(stack, tilt=None).transposed(), plane_from_local @ _SWAPPED
    elif not apart_m.any():  # if a single eye stands in for both there is no difference, so any line will do
        eyes_m = eyes_m + HALF_BASELINE_M * np.array([[0.0, -1.0, 0.0], [0.0, 1.0, 0.0]])
    order = (0, 1) if eyes_m[1, 1] >= eyes_m[0, 1] else (1, 0)
    return _Local(stack, eyes_m[list(order)], order, plane_from_local)


def _wave_taper(geometry: Geometry, raster: PlaneRaster, middle_m: F64) -> F32:
    """Return the taper (rows, columns) of an outer panel: 0 at the window's edges, 1 inside."""
    stack, kept = geometry.stack, geometry.kept
    centre = stack.panel(stack.count // 2)
    share = (centre.x_m - raster.x_m) / (middle_m[0] - raster.x_m)
    y_m = raster.left_m + (np.arange(raster.width_px) + 0.5) * raster.pitch_u_m
    z_m = raster.top_m - (np.arange(raster.height_px) + 0.5) * raster.pitch_v_m
    u = (y_m + (middle_m[1] - y_m) * share - centre.left_m) / centre.pitch_u_m
    v = (centre.top_m - z_m - (middle_m[2] - z_m) * share) / centre.pitch_v_m
    across = taper(u, kept.u0, kept.u1, stack.width_px, geometry.taper_px[0])
    down = taper(v, kept.v0, kept.v1, stack.height_px, geometry.taper_px[1])
    return np.asarray(across * down[:, None], np.float32)
