"""Eye poses, and projections onto images and panels.

The equations come from sections 2.1 and 3.1 of the EyeReal supplement, with the corrections in docs/mathematics.md.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from runtime.optics.stack import PlaneRaster
from runtime.records import F64


def stack_from_eye(eye_m: ArrayLike) -> F64:
    """Return the 4x4 pose of an eye that looks at the stack's origin (EyeReal supplement, (10)-(14)). x
    points right and is parallel to the ground, y points up, and z from the scene towards the eye. For an eye on the
    vertical axis, the pose is the limit from +x (r_x = +y). Raises ValueError if the eye is at the origin or not
    finite.
    """
    eye = np.asarray(eye_m, dtype=np.float64)
    scale = float(np.abs(eye).max())
    if not np.isfinite(scale) or scale == 0.0:
        raise ValueError(f"an eye at {eye.tolist()} has no direction of gaze")
    # Scale the eye first, because the squares of 1e-200 and 1e200 are outside the float64 range.
    back = eye / scale
    back = back / math.hypot(*back)
    # Use the unscaled eye, because x and y near the vertical axis may be too small to survive the scaling.
    off_axis = float(np.abs(eye[:2]).max())
    along = eye[:2] / off_axis if off_axis > 0.0 else np.array([1.0, 0.0])
    along = along / math.hypot(*along)
    right = np.array([-along[1], along[0], 0.0])
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3] = right, np.cross(back, right), back, eye
    return pose


def image_from_camera(*, width_px: int, height_px: int, fov_deg: float) -> F64:
    """Return the 3x3 intrinsic matrix for a horizontal field of view and square pixels (equation (36))."""
    focal_px = width_px / 2 / math.tan(math.radians(fov_deg) / 2)
    return np.array([[focal_px, 0.0, width_px / 2], [0.0, focal_px, height_px / 2], [0.0, 0.0, 1.0]])


def image_from_stack(eye_m: ArrayLike, *, width_px: int, height_px: int, fov_deg: float) -> F64:
    """Return the 3x4 projection from `stack` to an eye's image, K·diag(1, -1, -1)·R_e^T·[I | -e]
    ((31)-(39)). The third homogeneous coordinate is the distance along the gaze in metres, positive in front of the
    eye.
    """
    pose = stack_from_eye(eye_m)
    rotation = np.diag([1.0, -1.0, -1.0]) @ pose[:3, :3].T
    translation = -rotation @ pose[:3, 3]
    camera = image_from_camera(width_px=width_px, height_px=height_px, fov_deg=fov_deg)
    return camera @ np.column_stack([rotation, translation])


def raster_from_stack(eye_m: ArrayLike, raster: PlaneRaster) -> F64:
    """Return the 3x4 projection from `stack` to raster pixels along an eye's rays: M_RPU times any
    `image_from_stack`. The third homogeneous coordinate is the distance from the point to the eye along x, in metres.
    """
    eye = np.asarray(eye_m, dtype=np.float64)
    depth = raster.x_m - eye[0]
    # A point p is mapped to e + (p - e)·(x_plane - e_x)/(p_x - e_x), written with the weight e_x - p_x.
    plane_from_stack = np.array(
        [
            [-eye[1], -depth, 0.0, eye[1] * eye[0] + eye[1] * depth],
            [-eye[2], 0.0, -depth, eye[2] * eye[0] + eye[2] * depth],
            [-1.0, 0.0, 0.0, eye[0]],
        ]
    )
    result: F64 = raster.raster_from_plane() @ plane_from_stack
    return result


def image_from_raster(image_from_stack: F64, raster: PlaneRaster) -> F64:
    """Return the 3x3 homography from raster pixels to pixels in an eye's image (H in (40)-(42))."""
    return image_from_stack[:, :3] @ raster.stack_from_raster() + np.outer(image_from_stack[:, 3], [0.0, 0.0, 1.0])
