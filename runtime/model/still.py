"""Solve still pictures, for the `solve` command, the report and the calibration charts."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from runtime.clock import Stopwatch
from runtime.model.base import STAGES, Prediction, Predictor
from runtime.model.geometry import TargetView
from runtime.model.job import Job, Targets
from runtime.model.trim import trim
from runtime.model.warp import resized_px, source_px
from runtime.optics.pupil import TRACKING_SIGMA_MM
from runtime.optics.stack import PanelStack
from runtime.optics.views import image_from_raster, image_from_stack
from runtime.records import U8, Eyes

RAYS_PX = 0.6, 1.6  # pictures with fewer or more pixels per panel pixel are resized to have one


def solve_still(
    *pictures: U8,
    eyes_m: Eyes,
    fov_deg: float,
    predictor: Predictor,
    eye_sigma_mm: float = TRACKING_SIGMA_MM,
    trimmed: bool = False,
    steps: int | None = None,
    floats: bool = False,
) -> Prediction:
    """Compute the layers for each eye's picture, taken by a camera at the eye that is aimed at the
    stack's origin. The solver follows the rays of the picture pixels. `trimmed` skips work that the pictures do not
    need, if the model supports it and `floats`, the layers before rounding, are not requested; `steps` defaults to the
    model's.
    """
    watch = Stopwatch(*STAGES)
    codes = [np.ascontiguousarray(picture[..., :3]) for picture in pictures]
    views = captured_views(codes, eyes_m, predictor.stack, fov_deg=fov_deg)
    job = Job(Targets(predictor.stack, eyes_m, views), eye_sigma_m=eye_sigma_mm / 1e3, steps=steps, floats=floats)
    if trimmed and len(views) > 1 and not floats and predictor.facts.trims:
        job = trim(job)
    watch.lap("prepare")
    return predictor.solve(job, watch)


def captured_views(
    pictures: Sequence[U8], eyes_m: Eyes, stack: PanelStack, *, fov_deg: float
) -> tuple[TargetView, ...]:
    """Return the views for pictures of cameras aimed at the origin, resized to the panels' pixels."""
    height, width = pictures[0].shape[:2]
    middle = stack.panel(stack.count // 2)
    at = [image_from_stack(eye_m, width_px=width, height_px=height, fov_deg=fov_deg) for eye_m in eyes_m]
    scales = source_px(image_from_raster(at[0], middle), (middle.width_px, middle.height_px))
    across, down = (1.0 if RAYS_PX[0] <= scale <= RAYS_PX[1] else scale for scale in scales)
    size = resized_px(width, across), resized_px(height, down)
    if size != (width, height):
        method = cv2.INTER_AREA if max(across, down) > 1 else cv2.INTER_CUBIC
        pictures = [np.asarray(cv2.resize(picture, size, interpolation=method), np.uint8) for picture in pictures]
        resized = np.diag([size[0] / width, size[1] / height, 1.0])
        at = [resized @ projection for projection in at]
    return tuple(
        TargetView(picture, middle.plane_from_raster() @ np.linalg.inv(image_from_raster(projection, middle)))
        for picture, projection in zip(pictures, at, strict=True)
    )
