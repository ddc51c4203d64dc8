"""Compute the viewer's eye positions, and their covariance, from camera pictures."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from runtime.clock import NS_PER_S
from runtime.config import Settings
from runtime.eyes.face_depth import EyeDepths, FaceDepth
from runtime.eyes.liveness import Sign
from runtime.eyes.pupils import SIDES, PupilFinder, Pupils
from runtime.records import F64, EyePoints, Intrinsics, SensorFrame

# Standard deviation of the eyes' midpoint, relative to one pupil's. The two pupils' sideways errors are nearly
# independent, but their vertical errors are the same.
MIDDLE_SIDEWAYS, MIDDLE_UP = 0.55, 1.1
RANGE_MAX_M = 4.0  # a face farther away than this is not a viewer
SEARCH_NS = NS_PER_S // 2  # time between two searches for further people
LOCK_NS = NS_PER_S  # a viewer unseen for this long is replaced; a passer-by blocks the view for less time
FILLED_IN_CONFIDENCE = 0.4  # confidence in a hidden eye with an inferred position

log = logging.getLogger(__name__)


class EyeFinder:
    """Finder of people's eyes in pictures: `find` follows one viewer, `find_all` as many as
    `most_people`.

    `choice` says how the viewer was chosen, `reason` why no eyes of the viewer were found in the last frame, or "".
    `pupils` are those found there, even if their distance is unknown. `found` is None: pages show nothing.
    """

    found = None

    def __init__(self, settings: Settings | None = None, *, most_people: int = 1) -> None:
        """Create a finder. `settings.calibration` may have the viewer's eye separation."""
        settings = settings or Settings()
        new_depth = partial(FaceDepth, eye_distance_m=settings.calibration.ipd_m)
        self._first = _Follower(PupilFinder(lock_ns=LOCK_NS), new_depth)
        finders = (PupilFinder(lock_ns=LOCK_NS, shares=self._first.finder) for _ in range(most_people - 1))
        self._others = [_Follower(finder, new_depth) for finder in finders]
        self._searched_ns = -SEARCH_NS  # when a free follower last searched a picture

    def forget(self) -> None:
        """Forget all people. The next frame is treated as the first one."""
        for follower in (self._first, *self._others):
            follower.finder.forget()
        self._searched_ns = -SEARCH_NS

    @property
    def choice(self) -> str:
        return self._first.finder.choice

    @property
    def reason(self) -> str:
        return self._first.reason

    @property
    def pupils(self) -> Pupils | None:
        return self._first.pupils

    @property
    def points(self) -> EyePoints | None:
        """The viewer's eyes in the last frame."""
        return self._first.points

    @property
    def others_pupils(self) -> list[Pupils]:
        """Pupils of the further people found by `find_all` in the last frame."""
        return [follower.pupils for follower in self._others if follower.pupils is not None]

    def find(self, frame: SensorFrame) -> EyePoints | None:
        """Return the viewer's eyes in the sensor frame, or return None and store the cause in `reason`. The
        sample needs colour and intrinsics; depth, if any, must be registered to colour.
        """
        return self._first.find(frame, taken=self._faces_except(self._first))

    def find_all(self, frame: SensorFrame, *, is_still: bool = False) -> tuple[EyePoints, ...]:
        """Return all people's eyes, nearest first, in the sensor frame. Apart from the viewer, a face counts
        as a person only once it has moved or blinked, or if `is_still`, in a picture without predecessors.
        """
        found = [self.find(frame)]
        for follower in self._others:
            if follower.finder.is_free:
                if not is_still and frame.capture_ns - self._searched_ns < SEARCH_NS:
                    follower.pupils = None
                    continue
                self._searched_ns = frame.capture_ns
            points = follower.find(frame, taken=self._faces_except(follower))
            if is_still or follower.finder.has_lived:
                found.append(points)
        return tuple(sorted((points for points in found if points is not None), key=_range_m))

    def _faces_except(self, follower: _Follower) -> list[Sign]:
        others = (other.finder.sign for other in (self._first, *self._others) if other is not follower)
        return [sign for sign in others if sign is not None]


class _Follower:
    """Finds one person's eyes from frame to frame."""

    def __init__(self, finder: PupilFinder, new_depth: Callable[[], FaceDepth]) -> None:
        self.finder, self._new_depth = finder, new_depth
        self._depth, self._viewer = new_depth(), 0
        self.reason = ""  # why no eyes were found in the last frame
        self.pupils: Pupils | None = None
        self.points: EyePoints | None = None

    def find(self, frame: SensorFrame, *, taken: Sequence[Sign]) -> EyePoints | None:
        self.points = self._found(frame, taken)
        return self.points

    def _found(self, frame: SensorFrame, taken: Sequence[Sign]) -> EyePoints | None:
        self.pupils = None
        if frame.colour is None:
            self.reason = "the sensor does not deliver colour pictures"
            return None
        self.pupils = pupils = self.finder.find(frame.colour, time_ns=frame.capture_ns, taken=taken)
        if self.finder.viewer != self._viewer:
            log.info("viewer: %s", self.finder.choice)
            self._depth, self._viewer = self._new_depth(), self.finder.viewer
        self.reason = self.finder.reason
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


def _range_m(points: EyePoints) -> float:
    return float(np.linalg.norm(points.eyes_m.mean(axis=0)))


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
    """Return the (3, 3) covariance, in m², of the position of a point (3,) seen from the origin. The
    standard deviations are along the part of `line` (3,) perpendicular to the line of sight, perpendicular to both, and
    along the line of sight.
    """
    sight = point / np.linalg.norm(point)
    sideways = line - (line @ sight) * sight
    sideways = sideways / np.linalg.norm(sideways)
    axes = np.column_stack([sideways, np.cross(sight, sideways), sight])
    result: F64 = axes * np.square([sideways_m, up_m, along_m]) @ axes.T
    return result
