"""Two eyes in colour and depth: finds a viewer, keeps to that viewer, and says when it had to fill in."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from runtime.clock import NS_PER_S
from runtime.config import DetectorSettings
from runtime.errors import InputError
from runtime.eyes.eye_depth import FACE_DEPTH_M, depth_at, point_from_pixel
from runtime.eyes.faces import Face, FaceFinder, HaarFaces, YunetFaces
from runtime.records import F64, U8, EyePoints, Intrinsics, SensorFrame

FULL_WIDTH_PX = 640  # the whole picture is searched at this width
SMALLEST_FACE_PX = 32  # in it: 2 m away in a picture of 70 degrees
WINDOW_FACE_PX = 110  # in a window, the last face is brought to this width; networks go wrong on huge ones
WINDOW_SCALE = 2.0  # width of the window, in widths of the face
FULL_EVERY = 30  # frames between looks at the whole picture while a viewer is followed
SAME_FACE = 0.8  # a face further from the last one, in its widths, is another viewer's
POSE_AGE_S = 1.0  # a hidden eye is filled in from a head pose no older than this
COMPLETED_CONFIDENCE = 0.4
WINDOW_RADIUS = 0.16  # of an eye's depth window, in separations of the eyes
USUAL_SEPARATION = 0.45  # of eyes in widths of the face's box

log = logging.getLogger(__name__)


def make_finder(settings: DetectorSettings) -> FaceFinder:
    """The configured face finder. Raises InputError, MissingPart."""
    if settings.kind == "haar":
        return HaarFaces()
    if not settings.yunet_model:
        raise InputError("detector", "yunet_model", 'is needed by kind = "yunet"')
    return YunetFaces(Path(settings.yunet_model))


class EyeFinder:
    """Eyes of one viewer. `choice` says who that is and why; `reason` why the last frame gave no eyes."""

    def __init__(self, settings: DetectorSettings | None = None, *, finder: FaceFinder | None = None) -> None:
        self._settings = settings or DetectorSettings()
        self._finder = finder or make_finder(self._settings)
        self._face: Face | None = None
        self._seen_ns = self._pose_ns = 0
        self._left_to_right: F64 | None = None  # (3,) m, frame `sensor`
        self._frames = 0
        self.choice, self.reason = "nobody yet", ""

    def find(self, frame: SensorFrame) -> EyePoints | None:
        """The viewer's eyes in the `sensor` frame, or None; then `reason` says why.

        Needs colour, registered depth and intrinsics. A hidden eye is filled in from the last head pose.
        """
        if frame.colour is None or frame.depth_mm is None or frame.intrinsics is None:
            self.reason = "the sensor delivers no registered colour, depth and intrinsics"
            return None
        if self._face is not None and frame.capture_ns - self._seen_ns > self._settings.lock_s * NS_PER_S:
            self._face = None
            self.choice = "nobody: the viewer left"
        face = self._find_face(frame.colour, frame)
        if face is None:
            self.reason = "no face"
            return None
        self._face, self._seen_ns = face, frame.capture_ns
        return self._measure(face, frame, frame.intrinsics)

    def _find_face(self, colour: U8, frame: SensorFrame) -> Face | None:
        """The locked viewer's face, or, without one, the nearest face."""
        self._frames += 1
        locked = self._face
        if locked is not None and self._frames % FULL_EVERY:
            found = self._search_window(colour, locked)
            same = [face for face in found if _is_same(face, locked)]
            if same:
                return min(same, key=lambda face: float(np.linalg.norm(face.centre - locked.centre)))
        faces = self._search_all(colour)
        if locked is not None:
            same = [face for face in faces if _is_same(face, locked)]
            if len(faces) > len(same):
                self.choice = f"locked; {len(faces) - len(same)} other face(s) are ignored"
            return min(same, key=lambda face: float(np.linalg.norm(face.centre - locked.centre)), default=None)
        if not faces:
            return None
        face = min(faces, key=lambda face: self._distance_m(face, frame))
        self.choice = f"locked on the nearest of {len(faces)} face(s)"
        log.info("viewer: %s", self.choice)
        return face

    def _distance_m(self, face: Face, frame: SensorFrame) -> float:
        depth = self._face_depth(face, frame)
        # Without a measurement the larger face is taken for the nearer one, after all that are measured.
        return depth if depth is not None else self._settings.range_max_m + 1 / face.width

    def _search_window(self, colour: U8, face: Face) -> list[Face]:
        half = WINDOW_SCALE * face.width / 2
        height, width = colour.shape[:2]
        x0, y0 = max(int(face.centre[0] - half), 0), max(int(face.centre[1] - half), 0)
        x1, y1 = min(int(face.centre[0] + half) + 1, width), min(int(face.centre[1] + half) + 1, height)
        scale = WINDOW_FACE_PX / face.width
        if min(x1 - x0, y1 - y0) * scale < WINDOW_FACE_PX * 0.75:
            return []
        window = _resized(colour[y0:y1, x0:x1], scale)
        found = self._finder.find(
            window, smallest_px=round(0.7 * WINDOW_FACE_PX), largest_px=round(1.4 * WINDOW_FACE_PX)
        )
        return [one.moved(scale=1 / scale, offset=(x0, y0)) for one in found]

    def _search_all(self, colour: U8) -> list[Face]:
        scale = min(1.0, FULL_WIDTH_PX / colour.shape[1])
        small = _resized(colour, scale)
        found = self._finder.find(small, smallest_px=SMALLEST_FACE_PX, largest_px=min(small.shape[:2]))
        return [one.moved(scale=1 / scale, offset=(0.0, 0.0)) for one in found]

    def _face_depth(self, face: Face, frame: SensorFrame) -> float | None:
        assert frame.depth_mm is not None
        scale = _depth_scale(frame)
        return depth_at(
            frame.depth_mm,
            face.centre * scale,
            radius=face.width * float(scale[0]) / 4,
            nearest_m=self._settings.range_min_m,
            farthest_m=self._settings.range_max_m,
        )

    def _measure(self, face: Face, frame: SensorFrame, intrinsics: Intrinsics) -> EyePoints | None:
        assert frame.depth_mm is not None and frame.colour is not None
        scale = _depth_scale(frame)
        expected_m = self._face_depth(face, frame)
        if expected_m is None:
            self.reason = "no depth on the face"
            return None
        eyes = np.full((2, 3), np.nan)
        both = np.isfinite(face.eyes_px).all()
        separation = float(np.linalg.norm(face.eyes_px[0] - face.eyes_px[1])) if both else USUAL_SEPARATION * face.width
        for side in (0, 1):
            pixel = face.eyes_px[side]
            if not np.isfinite(pixel).all():
                continue
            depth_m = depth_at(
                frame.depth_mm,
                pixel * scale,
                radius=WINDOW_RADIUS * separation * float(scale[0]),
                nearest_m=self._settings.range_min_m,
                farthest_m=self._settings.range_max_m,
                expected_m=expected_m,
            )
            # What an eye's own window lacks (glasses, shadow) the face has.
            eyes[side] = point_from_pixel(pixel, depth_m if depth_m is not None else expected_m, intrinsics)
        return self._completed(eyes, face.confidence, frame.capture_ns)

    def _completed(self, eyes: F64, confidence: float, capture_ns: int) -> EyePoints | None:
        seen = np.isfinite(eyes).all(axis=1)
        if seen.all():
            line = eyes[1] - eyes[0]
            if abs(line[2]) > FACE_DEPTH_M / 2:
                self.reason = "the eyes' distances do not belong to one face"
                return None
            self._left_to_right, self._pose_ns = line, capture_ns
            self.reason = ""
            return EyePoints(eyes, np.full(2, confidence))
        if not seen.any():
            self.reason = "a face without eyes"
            return None
        if self._left_to_right is None or capture_ns - self._pose_ns > POSE_AGE_S * NS_PER_S:
            self.reason = "one eye is hidden, and the head's pose is not known"
            return None
        hidden: Literal["left", "right"] = "right" if np.isfinite(eyes[0]).all() else "left"
        if hidden == "right":
            eyes[1] = eyes[0] + self._left_to_right
        else:
            eyes[0] = eyes[1] - self._left_to_right
        self.reason = f"the {hidden} eye is hidden and filled in from the head's pose"
        return EyePoints(eyes, np.where(seen, confidence, min(COMPLETED_CONFIDENCE, confidence)), hidden)


def _is_same(face: Face, last: Face) -> bool:
    """True where a face may be the last one a moment later: near it, and of about its size."""
    near = float(np.linalg.norm(face.centre - last.centre)) <= SAME_FACE * last.width
    return near and 0.6 * last.width <= face.width <= 1.7 * last.width


def _depth_scale(frame: SensorFrame) -> F64:
    """(2,) depth pixels per colour pixel: registered images may differ in size."""
    assert frame.colour is not None and frame.depth_mm is not None
    result: F64 = np.array(frame.depth_mm.shape[::-1]) / np.array(frame.colour.shape[1::-1])
    return result


def _resized(picture: U8, scale: float) -> U8:
    if scale == 1.0:
        return np.ascontiguousarray(picture)
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(picture, None, fx=scale, fy=scale, interpolation=how), dtype=np.uint8)
