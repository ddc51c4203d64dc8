"""Retina pictures of an eye that focuses at a distance, and their error (docs/contracts.md).

The eye sees the mean of the pinhole pictures through all points of its pupil. To focus on a plane x = plane_m, these
pictures are drawn on the same pixels of that plane, so that they coincide for points on it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from runtime.optics.pupil import PUPIL_MM
from runtime.optics.quality import psnr_db, squared_error
from runtime.optics.retina import Retina, average, layers_from_image, pupil_points, through_layers
from runtime.optics.stack import PanelStack, Plane, PlaneRaster
from runtime.optics.views import raster_from_stack, stack_from_eye
from runtime.records import F32, F64, U8, Eyes

# Points of each pupil that get separate pictures when content is solved for focus, as (right, up) in metres. The centre
# comes first, because the network proposes panels for it; steps alternate between the level and the upright ones. With
# two points, the picture on the retina is worse than without any.
SOLVED_POINTS_M = ((0.0, 0.0), (0.0012, 0.0), (-0.0012, 0.0), (0.0, 0.0012), (0.0, -0.0012))


@dataclass(frozen=True, slots=True)
class RetinaPixels:
    """Pixels of a retina picture: the middle panel's, or a part of them, as the eye sees them.

    With smaller ones, the panels' own pixels would dominate the error, whether the eye can focus or not.
    """

    raster: PlaneRaster  # in the plane of the middle panel
    every: int = 1  # only every n-th pixel of every n-th row is in the picture

    def on_plane(self, eye_m: F64, plane_m: float) -> PlaneRaster:
        """Return the pixels projected from an eye at (3,) in `stack` onto the plane x = `plane_m`."""
        raster = self.raster
        scale, shift_m = raster.plane.scale_shift_to(Plane(plane_m), eye_m)
        return replace(
            raster,
            x_m=plane_m,
            left_m=float(raster.left_m * scale + shift_m[0]),
            top_m=float(raster.top_m * scale + shift_m[1]),
            pitch_u_m=float(raster.pitch_u_m * scale),
            pitch_v_m=float(raster.pitch_v_m * scale),
        )

    def projections(self, eye_m: F64, *, plane_m: float) -> list[tuple[F64, F64]]:
        """Return points (3,) of an eye's pupil, the centre first, with the 3x4 projection of `stack` through
        each to the pixels, for an eye that focuses on the plane x = `plane_m`.
        """
        raster, pose = self.on_plane(eye_m, plane_m), stack_from_eye(eye_m)
        points = eye_m + pupil_points(PUPIL_MM / 1e3) @ pose[:3, :2].T
        return [(point, raster_from_stack(point, raster)) for point in points]

    def seen(self, layers: U8, stack: PanelStack, eye_m: F64, *, plane_m: float) -> Retina:
        """Compute the retina picture of an eye that looks through layers and focuses on x = `plane_m`."""
        u, v = (np.arange(0, count, self.every) + 0.5 for count in (self.raster.width_px, self.raster.height_px))
        mask = np.ones((len(v), len(u)), bool)

        def through(point: F64, projection: F64) -> F32:
            retina = through_layers(layers, layers_from_image(projection, stack, point), u, v[:, None], mask)
            mask[:] = retina.mask
            return retina.image

        image = average(through(*ray) for ray in self.projections(eye_m, plane_m=plane_m))
        return Retina(image, mask)

    def true(self, picture_of: Callable[[F64, F64], F32], eye_m: F64, *, plane_m: float) -> F32:
        """Return the (h, w, 3) retina picture of an eye that looks at a scene and focuses on x = `plane_m`.
        `picture_of` draws the picture from a point (3,) of the pupil through a projection.
        """
        drawn = (picture_of(point, matrix) for point, matrix in self.projections(eye_m, plane_m=plane_m))
        return average(picture[:: self.every, :: self.every] for picture in drawn)


@dataclass(frozen=True, slots=True)
class FocusTargets:
    """A scene's own retina pictures of two eyes that focus on its front, its middle and its rear."""

    pixels: RetinaPixels
    eyes_m: F64  # (2, 3) frame `stack`
    planes_m: tuple[float, ...]  # x of the planes in focus, frame `stack`
    pictures: tuple[U8, ...]  # (h, w, 3) those of the left and right eye for each plane in turn

    def seen(self, layers: U8, stack: PanelStack) -> list[Retina]:
        """Compute the retina pictures of the same eyes, focused likewise, that look through layers."""
        return [
            self.pixels.seen(layers, stack, eye_m, plane_m=plane_m)
            for plane_m in self.planes_m
            for eye_m in self.eyes_m
        ]


def retina_db(pictures: Iterable[tuple[Retina, F32]]) -> float:
    """Return the PSNR, of one mean squared error, of retina pictures against the scene's own, (h, w, 3).
    There is a pair of pictures for each eye and each of three distances. NaN if no ray crosses all panels.
    """
    total, counted = 0.0, 0
    for seen, true in pictures:
        error, terms = squared_error(seen.image, true, seen.mask)
        total, counted = total + error, counted + terms
    return psnr_db(total / counted) if counted else math.nan


def points_of_pupils(eyes_m: Eyes) -> F64:
    """Return the (P·V, 3) points of pupils that get separate pictures for focus: all eyes for each point."""
    right, up = stack_from_eye(eyes_m.mean(axis=0))[:3, 0], np.array([0.0, 0.0, 1.0])
    return np.concatenate([eyes_m + across_m * right + up_m * up for across_m, up_m in SOLVED_POINTS_M])
