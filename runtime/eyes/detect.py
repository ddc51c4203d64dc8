"""Compute the viewer's eye positions, and their covariance, from camera pictures."""

from __future__ import annotations

import logging
from functools import partial

import numpy as np

from runtime.clock import NS_PER_S
from runtime.config import Settings
from runtime.eyes.face_depth import EyeDepths, FaceDepth
from runtime.eyes.pupils import SIDES, PupilFinder, Pupils
from runtime.records import F64, EyePoints, Intrinsics, SensorFrame

# Standard deviation of the eyes' midpoint, relative to one pupil's. The two pupils' sideways errors are nearly
# independent, but their vertical errors are the same.
MIDDLE_SIDEWAYS, MIDDLE_UP = 0.55, 1.1
RANGE_MAX_M = 4.0  # a face farther away than this is not a viewer
LOCK_NS = NS_PER_S  # a viewer unseen for this long is replaced; a passer-by blocks the view for less time
FILLED_IN_CONFIDENCE = 0.4  # confidence in a hidden eye with an inferred position

log = logging.getLogger(__name__)


class EyeFinder:
    """Finder that locates one viewer's eyes in camera pictures and ignores other people.

    Attributes:
        choice: Description of how the viewer was chosen.
        reason: Why no eyes were found in the last frame, or an empty string.
        pupils: Pupils found in the last frame, even if their distance is unknown. None if there were none.
    """

    def __init__(self, settings: Settings | None = None) -> None:
        """Create a finder. `settings.calibration` may have the viewer's eye separation."""
        settings = settings or Settings()
        self._new_depth = partial(FaceDepth, eye_distance_m=settings.calibration.ipd_m)
        self._finder = PupilFinder(lock_ns=LOCK_NS)
        self._depth, self._viewer = self._new_depth(), 0
        self.reason = ""
        self.pupils: Pupils | None = None

    def forget(self) -> None:
        """Forget the viewer. The next frame is treated as the first one."""
        self._finder.forget()

    @property
    def choice(self) -> str:
        return self._finder.choice

    def find(self, frame: SensorFrame) -> EyePoints | None:
        """Return the viewer's eyes in the sensor frame, or return None and store the cause in `reason`. The sample
        needs colour and intrinsics; depth, if any, must be registered to colour.
        """
        self.pupils = None
        if frame.colour is None:
            self.reason = "the sensor does not deliver colour pictures"
            return None
        self.pupils = pupils = self._finder.find(frame.colour, time_ns=frame.capture_ns)
        if self._finder.viewer != self._viewer:
            log.info("viewer: %s", self.choice)
            self._depth, self._viewer = self._new_depth(), self._finder.viewer
        self.reason = self._finder.reason
        if pupils is None or frame.intrinsics is None:
            self.reason = self.reason or "the distance of the eyes is unknown because the camera reports no intrinsics"
            return None
        scale = np.ones(2)
        if frame.depth_mm is not None:  # the registered pictures may differ in size
            scale = np.array(frame.depth_mm.shape[::-1]) / np.array(frame.colour.shape[1::-1])
        depths = self._depth.at(pupils, frame.depth_mm, frame.intrinsics, scale)
        if frame.depth_mm is not None and not self._depth.has_measured:
            self.reason = "the depth measured on the face does not match a person's size"
            return None
        if depths.eyes_m.mean() > RANGE_MAX_M:
            self.reason = f"the face is {depths.eyes_m.mean():.1f} m away, but the maximum is {RANGE_MAX_M:g} m"
            return None
        return _eye_points(pupils, depths, frame.intrinsics)


def _eye_points(pupils: Pupils, depths: EyeDepths, intrinsics: Intrinsics) -> EyePoints:
    i = intrinsics
    slopes = (pupils.eyes_px - [i.cx_px, i.cy_px]) / [i.fx_px, i.fy_px]
    eyes = np.column_stack([slopes, np.ones(2)]) * depths.eyes_m[:, None]
    confidence = np.full(2, pupils.certainty)
    if pupils.hidden:
        confidence[SIDES.index(pupils.hidden)] = min(FILLED_IN_CONFIDENCE, pupils.certainty)
    middle = eyes.mean(axis=0)
    across = pupils.sigma_px / np.sqrt(i.fx_px * i.fy_px) * middle[2]
    spread = covariance(middle, eyes[0] - eyes[1], MIDDLE_SIDEWAYS * across, MIDDLE_UP * across, depths.sigma_m)
    return EyePoints(eyes, confidence, pupils.hidden, spread)


def covariance(point: F64, line: F64, sideways_m: float, up_m: float, along_m: float) -> F64:
    """Return the (3, 3) covariance, in m², of the position of a point (3,) seen from the origin. The standard
    deviations are along the part of `line` (3,) perpendicular to the line of sight, perpendicular to both, and along
    the line of sight.
    """
    sight = point / np.linalg.norm(point)
    sideways = line - (line @ sight) * sight
    sideways = sideways / np.linalg.norm(sideways)
    axes = np.column_stack([sideways, np.cross(sight, sideways), sight])
    result: F64 = axes * np.square([sideways_m, up_m, along_m]) @ axes.T
    return result
