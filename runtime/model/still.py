"""One still stereo pair to layers: what `solve`, the report and the calibration charts drive."""

from __future__ import annotations

import numpy as np

from runtime.model.base import Prediction, Predictor
from runtime.optics.pupil import POINT_MM
from runtime.optics.stack import PlaneRaster
from runtime.optics.views import image_from_raster, image_from_stack
from runtime.records import F64, U8


def solve_still(
    left: U8,
    right: U8,
    *,
    eyes_m: F64,
    fov_deg: float,
    predictor: Predictor,
    eye_sigma_mm: float = POINT_MM,
) -> Prediction:
    """Layers for two pictures (h, w, 3 or 4) that a left and a right eye (2, 3), frame `stack`, should see.

    The pictures' horizontal field of view is `fov_deg`; each eye looks at the stack's origin. Warps each picture
    to the rasters that the predictor wants (seed 47). Its prepare time includes the warps.
    """
    import cv2

    start = cv2.getTickCount()
    rasters, windows = predictor.rasters(eyes_m), predictor.windows(eyes_m)
    images: list[list[U8]] = []
    for picture, eye_m in zip((left, right), eyes_m, strict=True):
        height, width = picture.shape[:2]
        rgba = np.asarray(picture if picture.shape[2] == 4 else cv2.cvtColor(picture, cv2.COLOR_RGB2RGBA), np.uint8)
        projection = image_from_stack(eye_m, width_px=width, height_px=height, fov_deg=fov_deg)
        images.append(
            [
                _warped(
                    rgba,
                    image_from_raster(projection, raster),
                    raster,
                    rows=rows,
                    columns=columns,
                    cubic=predictor.interpolation == "cubic",
                    black_beside=predictor.black_beside,
                )
                for raster, (rows, columns) in zip(rasters, windows, strict=True)
            ]
        )
    warps_ms = (cv2.getTickCount() - start) / cv2.getTickFrequency() * 1e3
    prediction = predictor.predict(images, eyes_m, eye_sigma_mm=eye_sigma_mm)
    stage_ms = dict(prediction.stage_ms)
    stage_ms["prepare"] = stage_ms.get("prepare", 0.0) + warps_ms
    return Prediction(prediction.layers, stage_ms)


def _warped(
    rgba: U8,
    image_from_raster: F64,
    raster: PlaneRaster,
    *,
    rows: slice,
    columns: slice,
    cubic: bool,
    black_beside: bool,
) -> U8:
    """A picture on a raster; only the given rows and columns are drawn."""
    import cv2

    out = np.zeros((raster.height_px, raster.width_px, 4), np.uint8)
    # OpenCV puts pixel centres at integers.
    matrix = _shifted(-0.5, -0.5) @ image_from_raster @ _shifted(columns.start + 0.5, rows.start + 0.5)
    out[rows, columns] = cv2.warpPerspective(
        rgba,
        matrix,
        (columns.stop - columns.start, rows.stop - rows.start),
        flags=(cv2.INTER_CUBIC if cubic else cv2.INTER_LINEAR) | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_CONSTANT if black_beside else cv2.BORDER_REPLICATE,
    )
    return out


def _shifted(right: float, down: float) -> F64:
    return np.array([[1.0, 0.0, right], [0.0, 1.0, down], [0.0, 0.0, 1.0]])
