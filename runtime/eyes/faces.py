"""Finding faces and the eyes in them, in pictures. Positions are continuous pixels, centres at half-integers."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np

from runtime.errors import InputError, MissingPart
from runtime.records import F64, U8

FACE_STEP, FACE_NEIGHBOURS = 1.15, 4
EYE_STEP, EYE_NEIGHBOURS = 1.1, 3
EYE_WORK_PX = 160  # a face is searched for eyes at this width
EYES_BELOW, EYES_ABOVE = 0.15, 0.62  # share of a face's height in which eyes lie
SEPARATION = (0.28, 0.65)  # of eyes, in widths of the face
ROLL_MAX = 0.6  # of the line between the eyes: rise over run


@dataclass(frozen=True, slots=True)
class Face:
    """A face in a picture. Eyes that were not found are NaN."""

    x: float
    y: float
    width: float
    height: float
    eyes_px: F64  # (2, 2) the viewer's left eye (on the right of the picture), then the right one
    confidence: float = 1.0

    @property
    def centre(self) -> F64:
        return np.array([self.x + self.width / 2, self.y + self.height / 2])

    def moved(self, *, scale: float, offset: tuple[float, float]) -> Face:
        """In another picture's pixels: p·scale + offset."""
        shift = np.array(offset)
        x, y = np.array([self.x, self.y]) * scale + shift
        eyes = self.eyes_px * scale + shift
        return Face(float(x), float(y), self.width * scale, self.height * scale, eyes, self.confidence)


class FaceFinder(Protocol):
    """Finds faces of a width between two limits, in pixels, largest first."""

    def find(self, picture: U8, *, smallest_px: int, largest_px: int) -> list[Face]:
        """picture: (h, w, 3) RGB."""


def _cascade(name: str) -> Any:
    place = Path(getattr(getattr(cv2, "data", None), "haarcascades", "/usr/share/opencv4/haarcascades")) / name
    cascade = cv2.CascadeClassifier(str(place)) if place.is_file() else None
    if cascade is None or cascade.empty():
        raise MissingPart(f"OpenCV's {name} is not installed (it comes with opencv-contrib-python-headless)")
    return cascade


class HaarFaces:
    """OpenCV's cascades: they come with its wheels, need no model file, and see faces from the front."""

    def __init__(self) -> None:
        self._faces = _cascade("haarcascade_frontalface_default.xml")
        self._eyes = _cascade("haarcascade_eye_tree_eyeglasses.xml")
        self._open_eyes = _cascade("haarcascade_eye.xml")

    def find(self, picture: U8, *, smallest_px: int, largest_px: int) -> list[Face]:
        grey: U8 = np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
        largest = min(largest_px, *grey.shape)
        boxes, _, weights = self._faces.detectMultiScale3(
            grey,
            FACE_STEP,
            FACE_NEIGHBOURS,
            minSize=(smallest_px, smallest_px),
            maxSize=(largest, largest),
            outputRejectLevels=True,
        )
        faces = [
            # 1 to 7 is what this cascade gives to borderline and to clear faces.
            Face(x, y, w, h, self._find_eyes(grey, (x, y, w, h)), float(np.clip((weight - 1) / 6, 0.5, 1)))
            for (x, y, w, h), weight in zip(np.reshape(boxes, (-1, 4)).tolist(), np.ravel(weights))
        ]
        return sorted(faces, key=lambda face: -face.width)

    def _find_eyes(self, grey: U8, box: tuple[int, int, int, int]) -> F64:
        x, y, w, h = box
        top, bottom = y + round(EYES_BELOW * h), y + round(EYES_ABOVE * h)
        scale = EYE_WORK_PX / w
        work = cv2.equalizeHist(cv2.resize(grey[top:bottom, x : x + w], None, fx=scale, fy=scale))
        best = np.full((2, 2), np.nan)
        for cascade in (self._eyes, self._open_eyes):
            found = cascade.detectMultiScale(work, EYE_STEP, EYE_NEIGHBOURS, minSize=(24, 24), maxSize=(64, 64))
            boxes = np.reshape(found, (-1, 4)).astype(np.float64)
            eyes = choose_eyes(boxes[:, :2] + boxes[:, 2:] / 2, width=EYE_WORK_PX)
            if np.isfinite(eyes).sum() > np.isfinite(best).sum():
                best = eyes
            if np.isfinite(best).all():
                break
        result: F64 = best / scale + np.array([x, top])
        return result


def choose_eyes(centres: F64, *, width: float) -> F64:
    """The likeliest left and right eye among candidates (n, 2), in a face of this width: (2, 2), NaN: none.

    A pair wins that lies symmetrically about the face's middle and level; else one eye, on its side.
    """
    best, cost = np.full((2, 2), np.nan), np.inf
    for right in centres:
        for left in centres:
            run, rise = left - right
            if not SEPARATION[0] * width < run < SEPARATION[1] * width or abs(rise) > ROLL_MAX * run:
                continue
            value = abs((left[0] + right[0]) / 2 - width / 2) + 0.5 * abs(rise)
            if value < cost:
                best, cost = np.array([left, right]), value
    if np.isfinite(cost) or len(centres) == 0:
        return best
    offsets = np.abs(np.abs(centres[:, 0] - width / 2) - 0.2 * width)
    eye = centres[int(np.argmin(offsets))]
    best[0 if eye[0] > width / 2 else 1] = eye
    return best


class YunetFaces:
    """OpenCV's YuNet: a small network that also sees turned faces. The model is a file of the user's."""

    def __init__(self, model: Path) -> None:
        """Raises InputError where the file is not such a model."""
        if not model.is_file():
            raise InputError("detector", "yunet_model", f"{model}: is not a file")
        try:
            self._detector = cv2.FaceDetectorYN.create(str(model), "", (320, 320), 0.7, 0.3, 50)
        except cv2.error as error:
            raise InputError("detector", "yunet_model", f"{model}: is not a YuNet model ({error.err})") from None

    def find(self, picture: U8, *, smallest_px: int, largest_px: int) -> list[Face]:
        height, width = picture.shape[:2]
        self._detector.setInputSize((width, height))
        _, rows = self._detector.detect(cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
        faces = []
        for row in rows if rows is not None else ():
            x, y, w, h, right_x, right_y, left_x, left_y = map(float, row[:8])
            if smallest_px <= w <= largest_px:
                eyes = np.array([[left_x, left_y], [right_x, right_y]]) + 0.5
                faces.append(Face(x, y, w, h, eyes, float(row[-1])))
        return sorted(faces, key=lambda face: -face.width)
