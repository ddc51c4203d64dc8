"""The distance of a viewer's eyes: measured on the rigid face and fused over time.

Without depth it follows from the separation of this viewer's eyes.

One number is followed: the viewer's eye distance in metres, as the depth measurements show it. A distance is that
number times the focal length over the eyes' distance in pixels (along the line between them in space, which the mesh
gives), so a hole or a frame of nonsense changes nothing, and the noise of the depth is averaged without a lag.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from runtime.eyes.face_flow import RIGID
from runtime.eyes.pupils import CORNERS, Pupils
from runtime.records import F64, U16, Intrinsics

M_PER_MM = 1e-3
EYE_DISTANCE_M = (0.063, 0.0036)  # of adults: mean, standard deviation
KNOWN_SIGMA_M = 0.001  # of an eye distance that an optician measured
IRIS_M, IRIS_SIGMA = 0.0117, 0.07  # diameter of an iris; people's spread and the network's, of it
PERSON_M = (0.045, 0.085)  # eye distances of people, children too; what else a depth makes of a face is not its depth
FLYING_M = 0.03  # off the other points: a pixel between the face and the wall, or the wall
POINTS_MIN = 8  # of the mesh's rigid points that must be measured
RELIEF_MAX, RELIEF_PICTURES = 1.3, 30  # of the mesh's; how many it is a mean of
POINT_SIGMA_M = 0.0005  # of many points together, at best: their errors are not independent
SHAPE_SIGMA_M = 0.006  # between this viewer's eyes and where the mesh has them, along the line of sight
EYE_SIGMA_M, EYE_GATE_M = 0.002, 0.02  # of one measurement at an eye; further off (glasses) it is none
EYE_WINDOW = 0.12  # radius of what is measured at an eye, in eye distances
PICTURE_SHARE, TURN_SHARE = 0.0007, 0.3  # of the eye distance that a picture and a turn of the head make unsure


@dataclass(frozen=True, slots=True)
class EyeDepths:
    """Distances along the camera's axis, m."""

    eyes_m: F64  # (2,) left, right
    sigma_m: float  # standard deviation of their middle


class FaceDepth:
    """The depth of one viewer's face from picture to picture. Another viewer has another one."""

    def __init__(self, *, eye_distance_m: float = 0.0) -> None:
        """eye_distance_m: this viewer's, where it is known; 0: it is learnt."""
        self._known = eye_distance_m > 0
        self._distance, sigma = (eye_distance_m, KNOWN_SIGMA_M) if self._known else EYE_DISTANCE_M
        self._variance = sigma**2
        self._shape, self._shape_variance = np.zeros(2), np.full(2, SHAPE_SIGMA_M**2)  # (2,) m, eyes less the mesh's
        self._relief, self._reliefs = 1.0, 0  # of the mesh's; pictures that it is known from
        self._foreshortening = 1.0
        self._irises: list[float] = []  # eye distances over iris diameters
        self.has_measured = False

    def at(self, pupils: Pupils, depth_mm: U16 | None, intrinsics: Intrinsics, depth_from_colour: F64) -> EyeDepths:
        """depth_mm: (h, w), 0 where nothing was measured; depth_from_colour: (2,) its pixels a colour pixel."""
        relief = pupils.mesh_px[:, 2]
        eyes = np.array([relief[list(corners)].mean() for corners in CORNERS])
        focal = float(np.sqrt(intrinsics.fx_px * intrinsics.fy_px))
        # Beside the picture's middle what lies across the line of sight is not at one distance along the camera's axis:
        # the mesh's z is along that line, and pixels are stretched there.
        middle_px = pupils.eyes_px.mean(axis=0)
        sight = (middle_px - [intrinsics.cx_px, intrinsics.cy_px]) / focal
        tilt = -sight / (1 + sight @ sight)  # pixels of depth a pixel of the picture
        apart = pupils.eyes_px[0] - pupils.eyes_px[1]
        across = np.sqrt(apart @ apart + (apart @ tilt) * (apart @ sight))
        length = float(np.hypot(across, eyes[0] - eyes[1]))
        tilts = (pupils.mesh_px[RIGID, :2] - middle_px) @ tilt, (pupils.eyes_px - middle_px) @ tilt
        away = focal / length  # distance of the eyes' middle, in eye distances
        self._predict(float(across) / length)
        relief, eyes = relief - eyes.mean(), eyes - eyes.mean()
        if depth_mm is not None:
            scale = self._distance / length  # m a pixel of the mesh
            tilts_m = tilts[0] * scale, tilts[1] * scale
            self._measure(pupils, depth_mm, depth_from_colour, relief * scale, eyes * scale, tilts_m, away)
        elif not self._known:
            self._learn(length / pupils.iris_px)
        middle = self._distance * away
        shape = self._shape - self._shape.mean()
        # What the pixels err by is within a distance that depth showed, and beside one that was known or learnt.
        beside = self._shape_variance.mean() if self.has_measured else 2 * (pupils.sigma_px / length * middle) ** 2
        sigma = np.sqrt(self._variance * away**2 + beside)
        relief_m = (eyes * self._relief + tilts[1]) * self._distance / length
        return EyeDepths(middle + relief_m + shape, float(sigma))

    def _predict(self, foreshortening: float) -> None:
        """A picture later; a turned head's eye distance is known as well as its turn."""
        turn = TURN_SHARE * (foreshortening - self._foreshortening)
        self._foreshortening = foreshortening
        if self.has_measured:
            self._variance += (PICTURE_SHARE**2 + turn**2) * self._distance**2

    def _learn(self, ratio: float) -> None:
        """Without a depth camera: people's irises differ less than their faces."""
        self._irises = [*self._irises[-99:], ratio]
        iris = IRIS_M * float(np.median(self._irises))
        weights = np.array([EYE_DISTANCE_M[1], IRIS_SIGMA * iris]) ** -2.0
        self._distance = float(weights @ [EYE_DISTANCE_M[0], iris] / weights.sum())
        self._variance = float(1 / weights.sum())

    def _measure(
        self,
        pupils: Pupils,
        depth_mm: U16,
        scale: F64,
        relief: F64,
        eyes: F64,
        tilts: tuple[F64, F64],
        away: float,
    ) -> None:
        """relief: (468,) m of the mesh; eyes: (2,) m of the eyes in it; away from the camera, from the eyes' middle.

        tilts: m of the rigid points, and (2,) of the eyes, on a plane across the line of sight.
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
        if not self.has_measured and not self._known:
            self._variance = EYE_DISTANCE_M[1] ** 2
        gain = self._variance / (self._variance + noise / away**2)
        self._distance += gain * (seen - self._distance)
        self._variance *= 1 - gain
        self.has_measured = True

    def _fit_relief(self, depths: F64, shape: F64) -> None:
        """How prominent this face is beside the mesh's; a picture of a face is flat."""
        off = shape - shape.mean()
        seen = float(np.clip(off @ (depths - depths.mean()) / max(float(off @ off), 1e-12), 0, RELIEF_MAX))
        self._reliefs = min(self._reliefs + 1, RELIEF_PICTURES)
        self._relief += (seen - self._relief) / self._reliefs


def _sampled(depth_mm: U16, points: F64) -> F64:
    """(n,) m at continuous pixels; 0 outside of the picture."""
    height, width = depth_mm.shape
    x, y = np.floor(points).astype(int).T
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    values: F64 = depth_mm[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)].astype(np.float64) * M_PER_MM
    return np.where(inside, values, 0.0)


def _window(depth_mm: U16, centre: F64, radius: float) -> F64:
    """(n,) m of the pixels around a place."""
    height, width = depth_mm.shape
    x0, y0 = np.clip(np.floor(centre - radius), 0, [width, height]).astype(int)
    x1, y1 = np.clip(np.floor(centre + radius) + 1, 0, [width, height]).astype(int)
    values: F64 = depth_mm[y0:y1, x0:x1].ravel().astype(np.float64) * M_PER_MM
    return values
