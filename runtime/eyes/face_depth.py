"""Estimate the distance from the camera to the viewer's eyes, averaged over time.

A filter estimates a single number from the depth measured on the rigid face: the viewer's eye separation in metres. The
distance is this separation times the focal length, divided by the eye separation in pixels. The separation in pixels is
measured in space along the line between the eyes, using the face mesh. Holes in the depth picture and bad frames
therefore do no harm, and averaging reduces depth noise without adding lag. If there are no depth pictures, the
separation in metres is taken from the settings or learnt from the size of the irises.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from runtime.eyes.face_flow import RIGID
from runtime.eyes.pupils import CORNERS, Pupils
from runtime.records import F64, U16, Eyes, Intrinsics

M_PER_MM = 1e-3
EYE_DISTANCE_M = (0.063, 0.0036)  # mean and standard deviation of adults' eye separations
KNOWN_SIGMA_M = 0.001  # standard deviation of an eye separation measured by an optician
IRIS_M, IRIS_SIGMA = 0.0117, 0.07  # iris diameter; relative spread due to different irises and the network's errors
PERSON_M = (0.045, 0.085)  # people's eye separations, including children's; depths that imply others are rejected
FLYING_M = 0.03  # a point that deviates more than this from the others is a flying pixel or on the wall
POINTS_MIN = 8  # minimum number of rigid mesh points with depth
RELIEF_MAX, RELIEF_PICTURES = 1.3, 30  # maximum ratio of a face's relief to the mesh's; number of pictures averaged
POINT_SIGMA_M = 0.0005  # minimum standard deviation of an average over many points, because their errors are correlated
SHAPE_SIGMA_M = 0.006  # standard deviation of an eye's depth relative to the mesh's
EYE_SIGMA_M, EYE_GATE_M = 0.002, 0.02  # standard deviation of depth at an eye; limit for deviations, to reject glasses
EYE_WINDOW = 0.12  # radius of the depth window around an eye, in eye separations
PICTURE_SHARE, TURN_SHARE = 0.0007, 0.3  # relative uncertainty added per picture and per change in foreshortening


@dataclass(frozen=True, slots=True)
class EyeDepths:
    """The eyes' distances from the camera along the optical axis, in metres."""

    eyes_m: Eyes  # (2,) left and right eye
    sigma_m: float  # standard deviation of the two distances' mean


class FaceDepth:
    """Estimator for the distance from the camera to one viewer's eyes. Each viewer needs a new instance."""

    def __init__(self, *, eye_distance_m: float = 0.0) -> None:
        """Create an estimator for a viewer's eye separation in metres, or 0 to estimate it from pictures."""
        self._known = eye_distance_m > 0
        self._distance, sigma = (eye_distance_m, KNOWN_SIGMA_M) if self._known else EYE_DISTANCE_M
        self._variance = sigma**2
        self._shape, self._shape_variance = np.zeros(2), np.full(2, SHAPE_SIGMA_M**2)  # (2,) m, eyes minus mesh
        self._relief, self._reliefs = 1.0, 0  # ratio of the face's relief to the mesh's; pictures averaged
        self._foreshortening = 1.0
        self._irises: list[float] = []  # ratios of eye separation to iris diameter
        self.has_measured = False

    def at(self, pupils: Pupils, depth_mm: U16 | None, intrinsics: Intrinsics, depth_from_colour: F64) -> EyeDepths:
        """Estimate both eyes' distances from the camera in one colour picture with `intrinsics`. `depth_mm`
        (h, w) is 0 where not measured. `depth_from_colour` (2,) are depth pixels per colour pixel.
        """
        relief = pupils.mesh_px[:, 2]
        eyes = np.array([relief[list(corners)].mean() for corners in CORNERS])
        focal = float(np.sqrt(intrinsics.fx_px * intrinsics.fy_px))
        # Away from the picture's centre, a plane perpendicular to the line of sight is tilted relative to the image
        # plane. The mesh's z axis follows the line of sight, and pixels are stretched.
        middle_px = pupils.eyes_px.mean(axis=0)
        sight = (middle_px - [intrinsics.cx_px, intrinsics.cy_px]) / focal
        tilt = -sight / (1 + sight @ sight)  # pixels of depth per picture pixel
        apart = pupils.eyes_px[0] - pupils.eyes_px[1]
        across = np.sqrt(apart @ apart + (apart @ tilt) * (apart @ sight))
        length = float(np.hypot(across, eyes[0] - eyes[1]))
        tilts = (pupils.mesh_px[RIGID, :2] - middle_px) @ tilt, (pupils.eyes_px - middle_px) @ tilt
        away = focal / length  # distance of the eyes' midpoint, in eye separations
        self._predict(float(across) / length)
        relief, eyes = relief - eyes.mean(), eyes - eyes.mean()
        if depth_mm is not None:
            scale = self._distance / length  # metres per mesh pixel
            tilts_m = tilts[0] * scale, tilts[1] * scale
            self._measure(pupils, depth_mm, depth_from_colour, relief * scale, eyes * scale, tilts_m, away)
        elif not (self._known or self.has_measured):
            self._learn(length / pupils.iris_px)
        middle = self._distance * away
        shape = self._shape - self._shape.mean()
        # An eye separation measured from depth already includes the pupils' pixel error. If the separation comes from
        # the settings or the irises, this error must be added.
        added = self._shape_variance.mean() if self.has_measured else 2 * (pupils.sigma_px / length * middle) ** 2
        sigma = np.sqrt(self._variance * away**2 + added)
        relief_m = (eyes * self._relief + tilts[1]) * self._distance / length
        return EyeDepths(middle + relief_m + shape, float(sigma))

    def _predict(self, foreshortening: float) -> None:
        """Increase the variance for a new picture, and for any turn of the head since the previous one."""
        turn = TURN_SHARE * (foreshortening - self._foreshortening)
        self._foreshortening = foreshortening
        if self.has_measured:
            self._variance += (PICTURE_SHARE**2 + turn**2) * self._distance**2

    def _learn(self, ratio: float) -> None:
        """Estimate the eye separation from its ratio to the iris diameter, which varies the least between people."""
        self._irises = [*self._irises[-99:], ratio]
        iris = IRIS_M * float(np.median(self._irises))
        weights = np.array([EYE_DISTANCE_M[1], IRIS_SIGMA * iris]) ** -2.0
        self._distance = float(weights @ [EYE_DISTANCE_M[0], iris] / weights.sum())
        self._variance = float(1 / weights.sum())

    def _measure(
        self, pupils: Pupils, depth_mm: U16, scale: F64, relief: F64, eyes: F64, tilts: tuple[F64, F64], away: float
    ) -> None:
        """Update the estimate from a depth picture with `scale` (2,) depth pixels per colour pixel.

        `relief` (468,) and `eyes` (2,) are depths of the mesh points and the eyes behind the eyes' midpoint, in metres;
        `tilts` are those that they would have on a plane perpendicular to the line of sight; `away` is the midpoint's
        distance, in eye separations.
        """
        face, shape = _sampled(depth_mm, pupils.mesh_px[RIGID, :2] * scale), relief[RIGID]
        good = face > 0
        face = face - tilts[0]
        for within in (2 * FLYING_M, FLYING_M):
            if good.sum() < POINTS_MIN:
                return
            off = face - self._relief * shape
            good &= np.abs(off - np.median(off[good])) < within
        if good.sum() < POINTS_MIN:
            return
        self._fit_relief(face[good], shape[good])
        depths, eyes = face[good] - self._relief * shape[good], eyes * self._relief
        middle = float(np.median(depths))
        spread = 1.4826 * float(np.median(np.abs(depths - middle)))
        if not PERSON_M[0] < middle / away < PERSON_M[1]:
            return
        radius = EYE_WINDOW * pupils.eye_distance_px * float(scale[0])
        for side in (0, 1):
            window = _window(depth_mm, pupils.eyes_px[side] * scale, radius)
            off = window - (middle + eyes[side] + tilts[1][side])
            off = off[(window > 0) & (np.abs(off) < EYE_GATE_M)]
            if len(off) >= max(1, len(window) // 4):
                gain = float(self._shape_variance[side]) / (self._shape_variance[side] + EYE_SIGMA_M**2)
                self._shape[side] += gain * (float(np.median(off)) - self._shape[side])
                self._shape_variance[side] *= 1 - gain
        noise = (1.25 * spread / np.sqrt(len(depths))) ** 2 + POINT_SIGMA_M**2
        seen = (middle + float(self._shape.mean())) / away
        gain = self._variance / (self._variance + noise / away**2)
        self._distance += gain * (seen - self._distance)
        self._variance *= 1 - gain
        self.has_measured = True

    def _fit_relief(self, depths: F64, shape: F64) -> None:
        """Update the ratio of the face's relief to the mesh's, which is near 0 for a printed face."""
        off = shape - shape.mean()
        seen = float(np.clip(off @ depths / max(float(off @ off), 1e-12), 0, RELIEF_MAX))
        self._reliefs = min(self._reliefs + 1, RELIEF_PICTURES)
        self._relief += (seen - self._relief) / self._reliefs


def _sampled(depth_mm: U16, points: F64) -> F64:
    """Return the (n,) depths at (n, 2) pixel positions, in metres. Outside the picture, the depth is 0."""
    height, width = depth_mm.shape
    x, y = np.floor(points).astype(int).T
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    values: F64 = depth_mm[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)].astype(np.float64) * M_PER_MM
    return np.where(inside, values, 0.0)


def _window(depth_mm: U16, centre: F64, radius: float) -> F64:
    """Return the (n,) depths, in metres, in a square of pixels around `centre` (2,), `radius` half its side."""
    height, width = depth_mm.shape
    x0, y0 = np.clip(np.floor(centre - radius), 0, [width, height]).astype(int)
    x1, y1 = np.clip(np.floor(centre + radius) + 1, 0, [width, height]).astype(int)
    values: F64 = depth_mm[y0:y1, x0:x1].ravel().astype(np.float64) * M_PER_MM
    return values
