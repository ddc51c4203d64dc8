"""One still stereo pair to layers: what `solve`, the report and the calibration charts drive."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np

from runtime.clock import Stopwatch
from runtime.model.base import STAGES, Prediction, Predictor
from runtime.model.job import Job, Own
from runtime.model.warp import resample, resized_px, source_px
from runtime.optics.pupil import TRACKING_SIGMA_MM
from runtime.optics.stack import PlaneRaster
from runtime.optics.views import image_from_raster, image_from_stack
from runtime.records import F64, U8
from runtime.support.threads import parallel_map

RAYS_PX = 0.6, 1.6  # pixels of a picture, along a side, for one of a panel: others are resized to one for one


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
    """Layers for pictures (h, w, 3 or 4) of a left and a right eye (2, 3), frame `stack`.

    The pictures' horizontal field of view is `fov_deg`; each eye looks at the stack's origin. The solver looks along
    their pixels' own rays; for a network of whole pictures each is warped to the rasters that it wants (EyeReal
    supplement, (47)), which its prepare time includes. changed: the job that is solved instead, as `trim` has it.
    """
    watch = Stopwatch(*STAGES)
    rasters = predictor.rasters(eyes_m)
    pictures = [np.ascontiguousarray(picture[..., :3]) for picture in (left, right)]
    own = _own(pictures, eyes_m, rasters[len(rasters) // 2], fov_deg=fov_deg)
    images: Sequence[list[U8]] = ([], [])
    if predictor.needs_rasters:
        for side in (0, 1):
            images[side].extend(parallel_map(lambda raster, side=side: _warped(own, side, raster, predictor), rasters))  # type: ignore[misc]
    job = changed(Job(images, eyes_m, eye_sigma_mm=eye_sigma_mm, own=own))
    watch.lap("prepare")
    made = predictor.solve(job)
    stage_ms = {name: made.stage_ms.get(name, 0.0) + ms for name, ms in watch.stage_ms.items()}
    return Prediction(made.made, stage_ms, made.steps)


def _own(pictures: Sequence[U8], eyes_m: F64, middle: PlaneRaster, *, fov_deg: float) -> Own:
    """The pictures and their rays, about as many as the panels have pixels."""
    height, width = pictures[0].shape[:2]
    at = [image_from_stack(eye_m, width_px=width, height_px=height, fov_deg=fov_deg) for eye_m in eyes_m]
    scales = source_px(image_from_raster(at[0], middle), (middle.width_px, middle.height_px))
    across, down = (1.0 if RAYS_PX[0] <= scale <= RAYS_PX[1] else scale for scale in scales)
    size = resized_px(width, across), resized_px(height, down)
    if size != (width, height):
        how = cv2.INTER_AREA if max(across, down) > 1 else cv2.INTER_CUBIC
        pictures = [np.asarray(cv2.resize(picture, size, interpolation=how), np.uint8) for picture in pictures]
        resized = np.diag([size[0] / width, size[1] / height, 1.0])
        at = [resized @ projection for projection in at]
    return Own(pictures, np.stack(at))


def _warped(own: Own, side: int, raster: PlaneRaster, predictor: Predictor) -> U8:
    """An eye's picture on a raster, RGBA."""
    rgba = np.asarray(cv2.cvtColor(own.pictures[side], cv2.COLOR_RGB2RGBA), np.uint8)
    matrix, size = image_from_raster(own.projections[side], raster), (raster.height_px, raster.width_px)
    edge = cv2.BORDER_CONSTANT if predictor.black_beside else cv2.BORDER_REPLICATE
    return np.asarray(resample(rgba, matrix, size=size, edge=edge), np.uint8)
