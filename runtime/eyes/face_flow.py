"""Measure how a face moves between pictures from the optical flow of its rigid parts.

The face networks' errors are independent from one picture to the next. Optical flow between two pictures is far more
precise, to 1/50 pixel. The pupils therefore follow the flow, and the networks only correct them slowly.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from runtime.eyes.networks import resampled, transformed
from runtime.records import F64, U8

# Mesh points that move rigidly with the head: forehead, nose, cheeks and eye corners.
RIGID = np.array([
    6, 8, 9, 10, 168, 197, 195, 5, 4, 1, 151, 108, 337, 67, 297, 54, 284, 21, 251, 103, 332, 107, 336, 55, 285, 122,
    351, 196, 419, 114, 343, 188, 412, 116, 345, 117, 346, 50, 280, 101, 330, 36, 266, 205, 425, 33, 133, 263,
    362, 130, 359,
])  # fmt: skip
BRIDGE = 168  # mesh point on the bridge of the nose, between the eyes
SIZE = 192  # side of the grey crop in pixels
EYE_DISTANCE = 64.0  # distance between the eyes in the crop, in pixels
WINDOW = 17  # side of the window compared around each point, in crop pixels
RETURNS_WITHIN = 0.4  # a point is discarded if its forward-backward error is larger, in pixels
POINTS_MIN, INLIERS_MIN = 10, 8  # minimum number of tracked points, and of inliers that fit their similarity


class FaceFlow:
    """Optical flow that measures how a face has moved between a remembered picture and a new one."""

    def __init__(self) -> None:
        self._grey: Any = None
        self._crop_from_picture = np.eye(2, 3)
        self._mesh = np.zeros((0, 2))

    def remember(self, picture: U8, mesh: F64, eye_distance: float) -> None:
        """Remember the face in a picture, by its mesh (468, 3) and eye separation in pixels."""
        scale = EYE_DISTANCE / eye_distance
        offset = SIZE / 2 - scale * mesh[BRIDGE, :2]
        self._crop_from_picture = np.array([[scale, 0, offset[0]], [0, scale, offset[1]]])
        self._grey, self._mesh = self._crop(picture), mesh[RIGID, :2].copy()

    def moved(self, picture: U8, mesh: F64) -> F64 | None:
        """Return the (2, 3) similarity from the remembered picture's pixels to a new one's, with its mesh
        (468, 3). None if too few points can be tracked or fit a similarity.
        """
        grey = self._crop(picture)
        matrix = self._crop_from_picture
        start = (transformed(matrix, self._mesh) - 0.5).astype(np.float32)
        guess = (transformed(matrix, mesh[RIGID, :2]) - 0.5).astype(np.float32)
        there, is_there = _flow(self._grey, grey, start, guess)
        back, is_back = _flow(grey, self._grey, there, start.copy())
        good = (is_there[:, 0] > 0) & (is_back[:, 0] > 0) & (np.linalg.norm(back - start, axis=1) < RETURNS_WITHIN)
        if good.sum() < POINTS_MIN:
            return None
        similarity, inliers = cv2.estimateAffinePartial2D(
            start[good] + 0.5, there[good] + 0.5, ransacReprojThreshold=1.0, refineIters=20
        )
        if similarity is None or inliers.sum() < INLIERS_MIN:
            return None
        crop = np.vstack([matrix, [0, 0, 1]])
        result: F64 = (np.linalg.inv(crop) @ np.vstack([similarity, [0, 0, 1]]) @ crop)[:2]
        return result

    def _crop(self, picture: U8) -> Any:
        return cv2.cvtColor(resampled(picture, (SIZE, SIZE), self._crop_from_picture), cv2.COLOR_RGB2GRAY)


def _flow(before: Any, after: Any, start: Any, guess: Any) -> tuple[Any, Any]:
    """Track points (n, 2) from one grey picture to another; return positions and an (n, 1) mask of those found. `guess`
    are initial estimates of the positions, which are overwritten.
    """
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.01)
    ends, is_found, _ = cv2.calcOpticalFlowPyrLK(
        before, after, start, guess,
        winSize=(WINDOW, WINDOW), maxLevel=1, flags=cv2.OPTFLOW_USE_INITIAL_FLOW, criteria=criteria,
    )  # fmt: skip
    return ends, is_found
