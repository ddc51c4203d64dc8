"""Retina pictures of an eye that focuses at a distance, and their error (docs/contracts.md).

The eye sees the mean of the pinhole pictures through all points of its pupil. To focus at a distance f along the gaze,
these pictures are shifted until they coincide for points at that distance: the picture through the point (right, up) of
the pupil is shifted by focal_px·right/f to the right and by focal_px·up/f upwards.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from runtime.optics.pupil import PUPIL_MM
from runtime.optics.quality import psnr_db
from runtime.optics.retina import Rays, average, pupil_points, through_layers
from runtime.optics.stack import PanelStack
from runtime.optics.views import image_from_stack, stack_from_eye
from runtime.records import F32, F64, U8, Eyes

# Points of each pupil that get separate pictures when content is solved for focus, as (right, up) in metres. The centre
# comes first, because the network proposes panels for it; steps alternate between the level and the upright ones. With
# two points, the picture on the retina is worse than without any.
SOLVED_POINTS_M = ((0.0, 0.0), (0.0012, 0.0), (-0.0012, 0.0), (0.0, 0.0012), (0.0, -0.0012))


@dataclass(frozen=True, slots=True)
class FocusCamera:
    """Size and horizontal field of view of a retina picture."""

    width_px: int
    height_px: int
    fov_deg: float

    def projection(self, eye_m: F64, point_m: F64, *, focus_m: float) -> F64:
        """Return the 3x4 projection through a point (right, up) of the pupil, refocused to `focus_m` along
        the gaze. The third homogeneous coordinate of a projected point is its distance from the eye along the gaze, in
        metres.
        """
        centre = image_from_stack(eye_m, width_px=self.width_px, height_px=self.height_px, fov_deg=self.fov_deg)
        # As the pupil's point moves, points in front of the plane in focus move the opposite way, and points behind it
        # the same way.
        focal_px = self.width_px / 2 / math.tan(math.radians(self.fov_deg / 2))
        out_of_focus = centre[2] / focus_m - [0.0, 0.0, 0.0, 1.0]
        return centre + np.outer([focal_px * point_m[0], -focal_px * point_m[1], 0.0], out_of_focus)

    def through(self, matrix: F64, layers: U8, stack: PanelStack) -> F32:
        """Return the (h, w, 3) picture of the layers as seen through a projection."""
        u, v = (np.arange(count, dtype=np.float64) + 0.5 for count in (self.width_px, self.height_px))
        rays = Rays(matrix, u, v[:, None])
        panels = [stack.panel(index) for index in range(stack.count)]
        seen = through_layers(
            layers, lambda rows: (rays.on(panel, rows) for panel in panels), rays.toward_panels(), stack
        )
        return seen.image

    def focused(self, eye_m: F64, picture_of: Callable[[F64], F32], *, plane_m: float) -> F32:
        """Return the (h, w, 3) retina picture of an eye that focuses on the point (`plane_m`, 0, 0) in
        `stack`. `picture_of` returns the picture through a projection.
        """
        gaze = -stack_from_eye(eye_m)[:3, 2]
        focus_m = float((np.array([plane_m, 0.0, 0.0]) - eye_m) @ gaze)
        points = pupil_points(PUPIL_MM / 1e3)
        return average(picture_of(self.projection(eye_m, point, focus_m=focus_m)) for point in points)


def retina_db(pictures: Iterable[tuple[F32, F32]]) -> float:
    """Return the PSNR, of one mean squared error, of (h, w, 3) retina pictures against the scene's own.
    There is a pair of pictures for each eye and each of three distances.
    """
    total, counted = 0.0, 0
    for seen, true in pictures:
        error = np.asarray(seen, np.float64) - true
        total, counted = total + float((error * error).sum()), counted + error.size
    if not counted:
        raise ValueError("there must be at least one retina picture")
    return psnr_db(total / counted)


def points_of_pupils(eyes_m: Eyes) -> F64:
    """Return the (P·V, 3) points of pupils that get separate pictures for focus: all eyes for each point."""
    right, up = stack_from_eye(eyes_m.mean(axis=0))[:3, 0], np.array([0.0, 0.0, 1.0])
    return np.concatenate([eyes_m + across_m * right + up_m * up for across_m, up_m in SOLVED_POINTS_M])
