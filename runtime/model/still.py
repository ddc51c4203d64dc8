"""One still stereo pair to layers: what `solve`, the report and the calibration charts drive."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import chain

import cv2
import numpy as np

from runtime.model.base import Prediction, Predictor
from runtime.model.job import Job
from runtime.model.own_rays import refined
from runtime.model.unseen import extrapolate_border, is_whole, shown_of
from runtime.optics.pupil import TRACKING_SIGMA_MM
from runtime.optics.rect import PixelRect
from runtime.optics.stack import PlaneRaster
from runtime.optics.views import image_from_raster, image_from_stack
from runtime.records import F64, U8
from runtime.support.threads import at_once

FINE_ENOUGH = 1.5  # pixels of a picture for one of the raster: finer ones are sampled as they are
MIN_RAYS, MAX_RAYS = 0.5, 2.0  # pixels of a picture for one of the raster, between which its rays are looked along
EDGE_PX = 2.0  # of a raster, beside a picture, that its outermost rays are interpolated from: its edge goes on there


def solve_still(
    left: U8,
    right: U8,
    *,
    eyes_m: F64,
    fov_deg: float,
    predictor: Predictor,
    eye_sigma_mm: float = TRACKING_SIGMA_MM,
    changed: Callable[[Job], Job] = lambda job: job,
) -> Prediction:
    """Layers for two pictures (h, w, 3 or 4) that a left and a right eye (2, 3), frame `stack`, should see.

    The pictures' horizontal field of view is `fov_deg`; each eye looks at the stack's origin. Warps each picture
    to the rasters that the predictor wants (EyeReal supplement, (47)); where one ends within the panels, nothing is
    driven for what it does not show (`unseen`). Where the predictor has steps for it, the layers are improved along the
    pictures' own rays (`own_rays`). Its prepare time includes the warps. changed: the job that is solved instead, as
    `trim` has it.
    """
    start = cv2.getTickCount()
    rasters, windows = predictor.rasters(eyes_m), predictor.windows(eyes_m)
    pictures = at_once(_with_alpha, (left, right))
    projections = [
        image_from_stack(eye_m, width_px=picture.shape[1], height_px=picture.shape[0], fov_deg=fov_deg)
        for picture, eye_m in zip(pictures, eyes_m, strict=True)
    ]
    pairs = [
        _drawn(pictures, projections, raster, rows=rows, columns=columns, predictor=predictor)
        for raster, (rows, columns) in zip(rasters, windows, strict=True)
    ]
    images = [list(of_eye) for of_eye in zip(*pairs, strict=True)]
    job = changed(Job(images, eyes_m, eye_sigma_mm=eye_sigma_mm))
    warps_ms = (cv2.getTickCount() - start) / cv2.getTickFrequency() * 1e3
    prediction = predictor.solve(job)
    rows, columns = windows[0]
    rays_px = [
        _source_px(image_from_raster(projection, rasters[0]), rows=rows, columns=columns) for projection in projections
    ]
    box = PixelRect(0, 0, predictor.stack.width_px, predictor.stack.height_px) if job.part is None else job.part.box
    steps, stage_ms, layers = predictor.refining, _added(prediction.stage_ms, {"prepare": warps_ms}), prediction.layers
    if not steps or not box.width_px or min(rays_px) <= MIN_RAYS or max(rays_px) >= MAX_RAYS:
        return Prediction(layers, stage_ms, prediction.steps)
    start = cv2.getTickCount()
    layers = refined(
        layers,
        pictures,
        predictor.stack,
        eyes_m=eyes_m,
        projections=projections,
        eye_sigma_mm=eye_sigma_mm,
        steps=steps,
        box=box,
        channels=job.channels,
        threads=max(1, cv2.getNumThreads()),
    )
    steps_ms = (cv2.getTickCount() - start) / cv2.getTickFrequency() * 1e3
    return Prediction(layers, _added(stage_ms, {"finish": steps_ms}), prediction.steps + len(steps))


def _drawn(
    pictures: Sequence[U8],
    projections: Sequence[F64],
    raster: PlaneRaster,
    *,
    rows: slice,
    columns: slice,
    predictor: Predictor,
) -> list[U8]:
    """Both eyes' pictures on a raster, for a predictor. On the centre panel's, what one does not show is made up."""
    matrices = [image_from_raster(projection, raster) for projection in projections]
    window = {"rows": rows, "columns": columns}
    images = [
        _warped(
            picture,
            matrix,
            raster,
            **window,
            interpolation=predictor.interpolation,
            black_beside=predictor.black_beside,
        )
        for picture, matrix in zip(pictures, matrices, strict=True)
    ]
    if predictor.black_beside or raster.x_m != predictor.stack.x_m[predictor.stack.count // 2]:
        return images
    shown = [
        shown_of(
            matrix,
            size=(picture.shape[1], picture.shape[0]),
            **window,
            margin_px=EDGE_PX * _source_px(matrix, **window),
        )
        for picture, matrix in zip(pictures, matrices, strict=True)
    ]
    if not all(is_whole(one, columns) for one in shown):
        extrapolate_border(images, shown, **window)
    return images


def _with_alpha(picture: U8) -> U8:
    return np.asarray(picture if picture.shape[2] == 4 else cv2.cvtColor(picture, cv2.COLOR_RGB2RGBA), np.uint8)


def _added(*stages: dict[str, float]) -> dict[str, float]:
    return {name: sum(part.get(name, 0.0) for part in stages) for name in dict.fromkeys(chain(*stages))}


def _warped(
    rgba: U8,
    image_from_raster: F64,
    raster: PlaneRaster,
    *,
    rows: slice,
    columns: slice,
    interpolation: str,
    black_beside: bool,
) -> U8:
    """A picture on a raster; only the given rows and columns are drawn."""
    whole = (rows.stop - rows.start, columns.stop - columns.start) == (raster.height_px, raster.width_px)
    out: U8 = (np.empty if whole else np.zeros)((raster.height_px, raster.width_px, 4), np.uint8)
    source_px = _source_px(image_from_raster, rows=rows, columns=columns)
    # OpenCV puts pixel centres at integers.
    matrix = _shifted(-0.5, -0.5) @ image_from_raster @ _shifted(columns.start + 0.5, rows.start + 0.5)
    cubic = interpolation == "cubic" and source_px < FINE_ENOUGH
    if cubic and not black_beside:
        from runtime.model.compiled.warp import is_level, warped  # noqa: PLC0415 - imports numba

        place = matrix / matrix[2, 2]
        if is_level(place, rows=rows, columns=columns, size=(rgba.shape[1], rgba.shape[0])):
            warped(rgba, place, out=out, rows=rows, columns=columns)
            return out
    cv2.warpPerspective(
        rgba,
        matrix,
        (columns.stop - columns.start, rows.stop - rows.start),
        dst=out[rows, columns],
        flags=(cv2.INTER_CUBIC if cubic else cv2.INTER_LINEAR) | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_CONSTANT if black_beside else cv2.BORDER_REPLICATE,
    )
    return out


def _source_px(image_from_raster: F64, *, rows: slice, columns: slice) -> float:
    """Pixels of the picture, along a side, for one of the raster, in the middle of what is drawn."""
    u, v = (columns.start + columns.stop) / 2, (rows.start + rows.stop) / 2
    x, y, w = image_from_raster @ (u, v, 1.0)
    a = image_from_raster
    jacobian = (a[:2, :2] - np.outer((x / w, y / w), a[2, :2])) / w
    return float(np.sqrt(abs(np.linalg.det(jacobian))))


def _shifted(right: float, down: float) -> F64:
    return np.array([[1.0, 0.0, right], [0.0, 1.0, down], [0.0, 0.0, 1.0]])
