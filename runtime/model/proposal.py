"""What the solver's steps begin with: the outer panels as a network proposes them along the line of the eyes.

The network sees the difference of both eyes' pictures on a raster of its own (`chain`), on which an eye's parallax is a
whole number of columns, and answers with both outer panels there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.clock import Stopwatch
from runtime.errors import EyesNotServed, ModelFailure
from runtime.model.chain import EVEN_COLUMNS, ChainFrame, ColumnLaw, chain_frame, chain_modes
from runtime.model.geometry import Geometry, taper
from runtime.model.job import Job
from runtime.model.session import ModelSession
from runtime.model.targets import FULL, REST, phase_codes, without_alpha
from runtime.optics.stack import PanelStack, PlaneRaster
from runtime.optics.tilt import coarse_layer_from_seen
from runtime.optics.views import image_from_raster
from runtime.records import F32, F64, I16, U8
from runtime.support.threads import at_once

HALF_IPD_M = 0.031
LEAST_PX, MIN_SCALE = 16, 0.25  # of a picture: smaller ones, and finer rasters, would tell nothing new
EDGE_PX, EDGE_SHARE = 4, 1 / 40  # of the raster, at most, and of a picture: so far beside it its edge goes on
SHARPENED = 0.07  # of the difference, on either side: what two interpolations blur
NODE_PX = 4  # of a result with bent columns: what lies between errs by a hundredth of a pixel
EVEN = REST[3] * FULL  # of an outer panel, sixteenths of a code
_SWAPPED = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # (y, z, 1) from (-z, -y, 1), and back


class Proposal(Protocol):
    """Where the steps begin."""

    def panels(self, job: Job, geometry: Geometry, watch: Stopwatch) -> dict[int, I16]:
        """Panels' boxes, at any size, (rows, columns[, 3]), sixteenths of a code; those that are missing rest.

        Raises ModelFailure, and of these EyesNotServed."""


@dataclass(frozen=True, slots=True)
class _Local:
    """A part of the panels as a stack of its own, turned so that the eyes are beside each other."""

    stack: PanelStack
    eyes_m: F64  # (2, 3), the first is the left one there
    order: tuple[int, int]  # which eyes these are
    plane_from_local: F64  # 3x3, (y, z, 1) of frame `stack`

    def in_stack(self, point_m: F64) -> F64:
        """(3,) in frame `stack`, of a point (3,) here."""
        y_m, z_m, _ = self.plane_from_local @ (point_m[1], point_m[2], 1.0)
        return np.array([point_m[0], y_m, z_m])


class ChainProposal:
    """Networks of `input_frame` chain: three panels, evenly spaced or nearly so, any pose."""

    def __init__(self, session: ModelSession) -> None:
        self.session = session
        self._cell_px, self._reduction = session.contract.cell_px, session.contract.reduction
        self._codes = phase_codes(session.contract.branch)

    def panels(self, job: Job, geometry: Geometry, watch: Stopwatch) -> dict[int, I16]:
        local = _local(geometry, whole=job.part is None)
        try:
            frame = chain_frame(local.eyes_m, local.stack, cell_px=self._cell_px, reduction=self._reduction)
        except ValueError as error:
            raise EyesNotServed(str(error)) from None
        lacked = self._lacked(job, geometry)
        raster = _coarser(geometry.rasters[geometry.middle], self._reduction)

        def seen(side: int) -> I16:
            to_plane = local.plane_from_local @ frame.plane_from_frame(local.eyes_m[side], x_m=raster.x_m)
            half = lacked if (side == 1) == (local.order == (0, 1)) else -lacked
            size = frame.rows, frame.width_px
            return resample(
                half, raster.raster_from_plane() @ to_plane, size=size, cubic=True, result_columns=frame.columns
            )

        left, right = at_once(seen, (0, 1))
        waves, shifted_waves, spectrum, modes_in = chain_modes(frame.cells)
        feeds: dict[str, NDArray[Any]] = {
            "left": left.reshape(frame.rows, frame.cells, -1),
            "right": right.reshape(frame.rows, frame.cells, -1),
            "waves": waves,
            "shifted_waves": shifted_waves,
            "spectrum": spectrum,
            "modes_in": modes_in,
            "doubt": frame.eye_sigma_px(local.stack, eye_sigma_mm=job.eye_sigma_mm),
        }
        shape = (frame.rows, frame.cells + 1, feeds["left"].shape[2])
        watch.lap("prepare")
        answer = self.session.run(feeds, {"rear": shape, "front": shape, "check": (1,)})
        if not np.isfinite(answer["check"]).all():
            raise ModelFailure("the network answered with numbers that are not finite")
        watch.lap("inference")
        outer = {n: answer[name].reshape(frame.rows, -1, *left.shape[2:]) for n, name in ((0, "rear"), (2, "front"))}
        found = at_once(lambda item: self._on_panel(*item, geometry, local, frame), list(outer.items()))
        return dict(zip(outer, found, strict=True))

    def _lacked(self, job: Job, geometry: Geometry) -> I16:
        """Half of what the right eye wants more than the left one, on a coarser raster of the middle panel's box."""
        left, right, unseen = coarse_pictures(job, geometry, self._reduction)
        half = np.asarray(cv2.subtract(cv2.LUT(right, self._codes), cv2.LUT(left, self._codes)), np.int16)
        half >>= 1
        if unseen is not None:
            half[unseen] = 0  # what one eye's picture does not show contradicts nothing
        kernel = np.array([-SHARPENED, 1 + 2 * SHARPENED, -SHARPENED])
        return np.asarray(cv2.sepFilter2D(half, cv2.CV_16S, kernel, kernel), np.int16)

    def _on_panel(self, n: int, answer: I16, geometry: Geometry, local: _Local, frame: ChainFrame) -> I16:
        """The network's answer for an outer panel on a coarser raster of its box."""
        raster = _coarser(geometry.rasters[n], self._reduction)
        middle_m = local.in_stack(frame.middle_m)
        seen_from_layer = np.linalg.inv(coarse_layer_from_seen(geometry.stack, n, middle_m))
        to_frame = frame.frame_from_plane(x_m=raster.x_m) @ np.linalg.inv(local.plane_from_local)
        # The answer begins one parallax before the first column.
        begin = np.array([[1.0, 0.0, frame.cell_px], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
        columns = ColumnLaw(frame.columns.bend, frame.columns.middle + frame.cell_px)
        matrix, size = (
            begin @ to_frame @ seen_from_layer @ raster.plane_from_raster(),
            (raster.height_px, raster.width_px),
        )
        codes = resample(answer, matrix, size=size, cubic=True, edge=cv2.BORDER_REPLICATE, image_columns=columns)
        np.clip(codes, 0, FULL, out=codes)
        if max(geometry.taper_px) > 0:
            weights = _wave_taper(geometry, raster, middle_m)
            weights = weights[..., None] if codes.ndim == 3 else weights
            codes = np.rint(EVEN + (codes - np.float32(EVEN)) * weights).astype(np.int16)
        return codes


def coarse_pictures(job: Job, geometry: Geometry, reduction: int) -> tuple[U8, U8, NDArray[np.bool_] | None]:
    """Both eyes' pictures (h, w[, 3]) on so many times fewer pixels of the middle panel's box, and which of those at
    least one picture does not show; None: there are none."""
    raster = _coarser(geometry.rasters[geometry.middle], reduction)
    size = raster.width_px, raster.height_px
    if job.own is None:
        box = geometry.boxes[geometry.middle]
        rows, columns = (slice(None), slice(None)) if job.part and job.part.drawn else box.slices
        drawn = [images[0][rows, columns] for images in job.arrays]
        shrunk = at_once(lambda image: cv2.resize(image, size, interpolation=cv2.INTER_AREA), drawn)
        left, right = (without_alpha(np.asarray(image), job.channels) for image in shrunk)
        return left, right, None

    def warped(item: tuple[U8, F64]) -> tuple[U8, U8]:
        picture, projection = item
        matrix = image_from_raster(projection, raster)
        height, width = picture.shape[:2]
        across, down = (max(scale, 1.0) for scale in source_px(matrix, size))
        if max(across, down) > 1:
            small = resized_px(width, across), resized_px(height, down)
            matrix = np.diag([small[0] / width, small[1] / height, 1.0]) @ matrix
            picture = np.asarray(cv2.resize(picture, small, interpolation=cv2.INTER_AREA), np.uint8)
        if job.channels == 1:
            picture = np.ascontiguousarray(picture[..., 0])
        height, width = picture.shape[:2]
        right, down = (min(EDGE_PX, int(px * EDGE_SHARE)) for px in (width, height))
        shown = np.full((height + 2 * down, width + 2 * right), 255, np.uint8)
        to_shown = np.array([[1.0, 0.0, right], [0.0, 1.0, down], [0.0, 0.0, 1.0]])
        found = resample(picture, matrix, size=size[::-1], cubic=True, edge=cv2.BORDER_REPLICATE)
        return np.asarray(found, np.uint8), np.asarray(resample(shown, to_shown @ matrix, size=size[::-1]), np.uint8)

    (left, of_left), (right, of_right) = at_once(warped, list(zip(job.own.pictures, job.own.projections, strict=True)))
    unseen = cv2.min(of_left, of_right) < 255
    return left, right, np.asarray(unseen) if unseen.any() else None


def source_px(image_from_raster: F64, size: tuple[int, int]) -> tuple[float, float]:
    """Pixels of an image, along and down, for one of a raster (width, height) along and down, in its middle."""
    a = image_from_raster
    x, y, w = a @ (size[0] / 2, size[1] / 2, 1.0)
    across, down = np.linalg.norm((a[:2, :2] - np.outer((x / w, y / w), a[2, :2])) / w, axis=0)
    return float(across), float(down)


def resized_px(pixels: int, scale: float) -> int:
    """As many pixels as a raster has in place of `pixels`, of which `scale` lie in one of its own."""
    return max(min(pixels, LEAST_PX), round(pixels / max(scale, MIN_SCALE)))


def resample(
    image: NDArray[Any],
    image_from_result: F64,
    *,
    size: tuple[int, int],
    cubic: bool = False,
    edge: int = cv2.BORDER_CONSTANT,
    image_columns: ColumnLaw = EVEN_COLUMNS,
    result_columns: ColumnLaw = EVEN_COLUMNS,
) -> NDArray[Any]:
    """Samples of an image (h, w[, C]) on a raster of (rows, columns), through a homography between what the two laws
    make of columns; pixel centres at half-integers. edge: OpenCV's name for what lies beside the image."""
    flags = cv2.INTER_CUBIC if cubic else cv2.INTER_LINEAR
    if not (image_columns.bend or result_columns.bend):
        matrix, flags = _at_centres(image_from_result), flags | cv2.WARP_INVERSE_MAP
        return np.asarray(cv2.warpPerspective(image, matrix, size[::-1], flags=flags, borderMode=edge))
    height, width = size
    columns, rows = (NODE_PX * (np.arange(-(-count // NODE_PX) + 2) - 0.5) for count in (width, height))
    u, v = result_columns.homography_from_column(columns), rows[:, None]
    x, y, w = (row[0] * u + row[1] * v + row[2] for row in image_from_result)
    nodes = image_columns.column_from_homography(x / w), y / w
    whole = [cv2.resize((place - 0.5).astype(np.float32), None, fx=NODE_PX, fy=NODE_PX) for place in nodes]
    at = [place[NODE_PX : NODE_PX + height, NODE_PX : NODE_PX + width] for place in whole]
    return np.asarray(cv2.remap(image, at[0], at[1], flags, borderMode=edge))


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
    if apart_m[2] > apart_m[1]:  # eyes above each other: what was down (-z) is to the right (+y)
        eyes_m = np.stack([eyes_m[:, 0], -eyes_m[:, 2], -eyes_m[:, 1]], axis=1)
        stack, plane_from_local = replace(stack, tilt=None).transposed(), plane_from_local @ _SWAPPED
    elif not apart_m.any():  # one eye that stands for both asks for no difference: any line will do
        eyes_m = eyes_m + HALF_IPD_M * np.array([[0.0, -1.0, 0.0], [0.0, 1.0, 0.0]])
    order = (0, 1) if eyes_m[1, 1] >= eyes_m[0, 1] else (1, 0)
    return _Local(stack, eyes_m[list(order)], order, plane_from_local)


def _coarser(raster: PlaneRaster, reduction: int) -> PlaneRaster:
    """The same rectangle in fewer pixels."""
    width, height = max(1, raster.width_px // reduction), max(1, raster.height_px // reduction)
    pitch_u_m, pitch_v_m = raster.pitch_u_m * raster.width_px / width, raster.pitch_v_m * raster.height_px / height
    return replace(raster, pitch_u_m=pitch_u_m, pitch_v_m=pitch_v_m, width_px=width, height_px=height)


def _wave_taper(geometry: Geometry, raster: PlaneRaster, middle_m: F64) -> F32:
    """(rows, columns): 0 at a window's edges to 1 inside, for an outer panel as it is seen from between the eyes."""
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


def _at_centres(matrix: F64) -> F64:
    """A homography of pixels whose centres are at halves, for OpenCV, whose are at integers."""
    to_corners = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])
    return np.asarray(np.linalg.inv(to_corners) @ matrix @ to_corners, np.float64)
