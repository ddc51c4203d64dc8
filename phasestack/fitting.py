"""Place an application's scene in the display, similar to its own view and not too deep."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phasestack.drawing import EyeRequest
from runtime.records import F64, Eyes

IPD_M = 0.063  # distance between the eyes, if only one is known
NEAREST = 0.9  # nothing is in view that is nearer to the camera than this share of the way from the focal point
ALL_DEPTHS = 1e9  # depth in metres that stands for "unlimited"


@dataclass(frozen=True, slots=True)
class AppCamera:
    """The application's camera, in its scene's units."""

    position: F64  # (3,)
    focus: F64  # (3,)
    up: F64  # (3,), not parallel to the direction of sight
    height: float  # height of the view at the focal point
    aspect: float  # width of the window, divided by its height


@dataclass(frozen=True, slots=True)
class EyeCamera:
    """A camera for one eye, in the scene's units."""

    position: F64  # (3,)
    sight: F64  # (3,) unit vector
    up: F64  # (3,) unit vector
    projection: F64  # (4, 4) OpenGL clip matrix from the camera's axes: x to the right, y up, z backwards
    near: float
    far: float


def axes_of(camera: AppCamera) -> F64:
    """Return the rotation (3, 3) from the scene's axes to those of frame `stack`."""
    backwards = camera.position - camera.focus
    backwards = backwards / np.linalg.norm(backwards)
    right = np.cross(camera.up, backwards)
    right /= np.linalg.norm(right)
    return np.array([backwards, right, np.cross(backwards, right)])


def comfortable_m(eyes_m: Eyes, comfort_deg: float) -> tuple[float, float]:
    """Return how far content may be in front of and behind the display, in metres, for (n, 3) eyes. A
    point nearer or farther than the display differs from it by the vergence angle ipd · (1/distance - 1/viewer), which
    is at most `comfort_deg`.
    """
    viewer_m = float(eyes_m[:, 0].mean())
    ipd_m = float(np.linalg.norm(eyes_m[0] - eyes_m[-1])) if len(eyes_m) > 1 else IPD_M
    vergence = np.radians(comfort_deg) / max(ipd_m, 1e-3)  # 1/m
    front_m = viewer_m - 1 / (1 / viewer_m + vergence)
    rear = 1 / viewer_m - vergence
    return front_m, (1 / rear - viewer_m if rear > 1 / ALL_DEPTHS else ALL_DEPTHS)


def stack_from_scene(
    camera: AppCamera, bounds: F64 | None, eyes_m: Eyes, display_m: tuple[float, float], comfort_deg: float
) -> F64:
    """Return the affine map (4, 4) from the application's scene, between corners `bounds` (2, 3), to
    frame `stack`. The focal point is at the display's centre, and the view there fills the display (width,
    height). A scene that would be deeper than `comfort_deg` of vergence for (n, 3) eyes is flattened.
    """
    axes, scale = axes_of(camera), display_m[1] / camera.height
    if camera.aspect * camera.height * scale > display_m[0]:
        scale = display_m[0] / (camera.aspect * camera.height)
    depth_scale = scale
    if bounds is not None:
        corners = np.array([[bounds[i, 0], bounds[j, 1], bounds[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
        along = (corners - camera.focus) @ axes[0]
        nearest = min(along.max(), NEAREST * float(np.linalg.norm(camera.position - camera.focus)))
        for reach, room_m in zip((nearest, -along.min()), comfortable_m(eyes_m, comfort_deg)):
            if reach * depth_scale > room_m:
                depth_scale = room_m / reach
    matrix = np.eye(4)
    matrix[:3, :3] = np.diag([depth_scale, scale, scale]) @ axes
    matrix[:3, 3] = -matrix[:3, :3] @ camera.focus
    return matrix


def eye_camera(eye: EyeRequest, placed: F64) -> EyeCamera:
    """Return the camera that draws an eye's picture, for a map from `stack_from_scene`. It is where the
    eye is in the scene and looks as the application's camera does, which keeps lights and volumes right also if the
    scene is flattened. Everything else is in its projection.
    """
    inverse = np.linalg.inv(placed)
    position = (inverse @ [*eye.eye_m, 1.0])[:3]
    rows = placed[:3, :3] / np.linalg.norm(placed[:3, :3], axis=1)[:, None]
    scene_from_camera = np.eye(4)
    scene_from_camera[:3, :3] = np.array([rows[1], rows[2], rows[0]]).T
    scene_from_camera[:3, 3] = position
    projection = eye.projection @ eye.view @ placed @ scene_from_camera
    depth_scale = float(np.linalg.norm(placed[0, :3]))
    near_m, far_m = clipping_of(eye.projection)
    return EyeCamera(position, -rows[0], rows[2], projection, near_m / depth_scale, far_m / depth_scale)


def clipping_of(projection: F64) -> tuple[float, float]:
    """Return the near and far distances of an OpenGL projection, in metres."""
    a, b = projection[2, 2], projection[2, 3]
    return float(b / (a - 1)), float(b / (a + 1))
