"""Motion of a face between pictures to 1/50 pixel: optical flow of its rigid parts.

The networks look at each picture anew and err anew. What a face's skin and hair did between two pictures is known far
better, so pupils follow the optical flow and are only slowly corrected by the networks.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from runtime.eyes.networks import resampled, transformed
from runtime.records import F64, U8

# Points of the mesh on forehead, nose, cheeks and the eyes' corners: what moves with the skull.
RIGID = np.array([
    6, 8, 9, 10, 168, 197, 195, 5, 4, 1, 151, 108, 337, 67, 297, 54, 284, 21, 251, 103, 332, 107, 336, 55, 285, 122,
    351, 196, 419, 114, 343, 188, 412, 116, 345, 117, 346, 50, 280, 101, 330, 36, 266, 205, 425, 33, 133, 263,
    362, 130, 359,
])  # fmt: skip
BRIDGE = 168  # of the nose, between the eyes
SIZE = 192  # pixels of the grey crop
EYE_DISTANCE = 64.0  # of the eyes in it, pixels
WINDOW = 17  # pixels of it that are compared around a point
RETURNS_WITHIN = 0.4  # pixels: a point that goes there and back ends where it began, or counts for nothing
POINTS_MIN, INLIERS_MIN = 10, 8


class FaceFlow:
    """The motion of a remembered face between pictures."""

    def __init__(self) -> None:
        self._grey: Any = None
        self._crop_from_picture = np.eye(2, 3)
        self._mesh = np.zeros((0, 2))

    def remember(self, picture: U8, mesh: F64, eye_distance: float) -> None:
        """The face as it is now. mesh: (468, 3) px; eye_distance: px."""
        scale = EYE_DISTANCE / eye_distance
        offset = SIZE / 2 - scale * mesh[BRIDGE, :2]
        self._crop_from_picture = np.array([[scale, 0, offset[0]], [0, scale, offset[1]]])
        self._grey, self._mesh = self._crop(picture), mesh[RIGID, :2].copy()

    def moved(self, picture: U8, mesh: F64) -> F64 | None:
        """(2, 3) similarity from the remembered face's pixels to the new picture's; None: unknown."""
        grey = self._crop(picture)
        matrix = self._crop_from_picture
        start = (transformed(matrix, self._mesh) - 0.5).astype(np.float32)
        guess = (transformed(matrix, mesh[RIGID, :2]) - 0.5).astype(np.float32)
        how: dict[str, Any] = {
            "winSize": (WINDOW, WINDOW),
            "maxLevel": 1,
            "flags": cv2.OPTFLOW_USE_INITIAL_FLOW,
            "criteria": (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.01),
        }
        there, is_there, _ = cv2.calcOpticalFlowPyrLK(self._grey, grey, start, guess, **how)
        back, is_back, _ = cv2.calcOpticalFlowPyrLK(grey, self._grey, there, start.copy(), **how)
        good = (is_there[:, 0] > 0) & (is_back[:, 0] > 0) & (np.linalg.norm(back - start, axis=1) < RETURNS_WITHIN)
        if good.sum() < POINTS_MIN:
            return None
        found, inliers = cv2.estimateAffinePartial2D(
            start[good] + 0.5, there[good] + 0.5, ransacReprojThreshold=1.0, refineIters=20
        )
        if found is None or inliers.sum() < INLIERS_MIN:
            return None
        crop = np.vstack([matrix, [0, 0, 1]])
        result: F64 = (np.linalg.inv(crop) @ np.vstack([found, [0, 0, 1]]) @ crop)[:2]
        return result

    def _crop(self, picture: U8) -> Any:
        return cv2.cvtColor(resampled(picture, (SIZE, SIZE), self._crop_from_picture), cv2.COLOR_RGB2GRAY)
