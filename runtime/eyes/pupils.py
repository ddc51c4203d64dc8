"""One viewer's pupils in pictures: found, followed, and kept apart from other people's."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Literal

import cv2
import numpy as np

from runtime.eyes.face_flow import BRIDGE, FaceFlow
from runtime.eyes.networks import FaceNetwork, FoundFace, IrisNetwork, MeshNetwork, Square, transformed
from runtime.records import F64, U8

Seen = Literal["found", "followed", "filled in"]
Side = Literal["", "left", "right"]
SIDES: tuple[Side, Side] = ("left", "right")

LEVELS_PX = (320, 640)  # longer side of the picture that is searched; the finer one where the first shows nobody
SCORE_MIN = 0.8  # of a face found: in the dark and 1.5 m away people come to 0.85, most dogs to less
PRESENCE_FOUND, PRESENCE_FOLLOWED = 0.9, 0.5  # of a face in the mesh's crop
CANDIDATES_MAX = 4  # faces that are looked at to find the viewer among them
FARTHEST_OUT = 0.7  # of its size a face at the picture's edge is worth less when a viewer is chosen
CORNERS = ((362, 263), (33, 133))  # of the left and the right eye, in the mesh
EYE_SQUARE = 2.7  # side of what the iris network looks at, in widths of the eye: the surest of 1.8 to 3.1
FACE_SQUARE = 1.5  # side of what the mesh looks at, in sizes of the face
MOVED_FAR = 0.35  # eye distances from one picture to the next: the mesh then looks again where the face is

# An iris measures 11.7 mm, eyes are 50 to 75 mm apart: a dog's or a monkey's do not look so.
IRIS_RANGE = (0.12, 0.33)  # diameter in eye distances; a turned head's are nearer to each other
IRIS_RATIO_MAX = 1.4  # of the larger to the smaller one
# The upper lid hides a part of the iris, and the network answers with the middle of what is left: too low, by this
# share of the eye distance (0.6 mm), whatever the camera and its distance. Fitted to all 51 faces that are measured;
# fitted to random halves of them it leaves the other half 0.61 to 0.67 mm of error up to 1 m.
TOO_LOW = 0.0093
OPEN_MIN = 0.12  # height of an open eye in its widths: below, a blink hides the iris

PULL = 0.1  # fraction of the way to the networks' estimate by which a pupil is corrected in each picture
# Further from it than the first (eye distances) the eyes turned: they are followed by as much of the way at the second.
GAZE_FROM, GAZE_FULL, GAZE_PULL = 0.02, 0.06, 0.6
# Eyes turn together: where one alone seems to, by more eye distances, it is hidden (a hand, hair), and the network
# makes it up. It is then carried along with the face, for so many pictures at most.
APART_MAX, CARRIED_MAX = 0.06, 30

SAME_LOOKS = 0.75  # correlation of two looks at one person, at least; 19 of 20 other people come to less
SAME_LOOKS_FOLLOWED = 0.6  # the same, of a face that is where the viewer's was a moment ago
LOOKS_PULL = 0.05  # how fast the memory of a viewer's looks changes with light and turn

# Standard deviation of a pupil along an axis: what people's eyes differ from what the networks learnt, in eye
# distances, and what a picture's pixels allow, px; per picture, beside that, the share of a surprise that stays.
SIGMA_PERSON, SIGMA_PICTURE_PX, SIGMA_SURPRISE = 0.0088, 0.14, 0.5


@dataclass(frozen=True, slots=True)
class Pupils:
    """A viewer's pupils in one picture."""

    eyes_px: F64  # (2, 2) left, right; continuous pixels
    sigma_px: float  # standard deviation of one pupil along one axis
    mesh_px: F64  # (468, 3) the face; z in the same pixels, away from the camera
    iris_px: float  # mean diameter of the irises
    seen: Seen
    hidden: Side  # the eye that was filled in from the rest of the face
    certainty: float  # that this is a face, 0 to 1

    @property
    def eye_distance_px(self) -> float:
        return float(np.linalg.norm(self.eyes_px[0] - self.eyes_px[1]))


@dataclass(frozen=True, slots=True)
class _Look:
    """The networks' estimates of one face in one picture."""

    mesh: F64  # (468, 3) px
    presence: float
    eyes: F64  # (2, 2) px
    iris: F64  # (2,) diameters, px
    openness: F64  # (2,) heights of the eyes in their widths
    looks: F64  # (468,) grey values at the mesh's points, of mean 0 and length 1

    @property
    def eye_distance(self) -> float:
        return float(np.linalg.norm(self.eyes[0] - self.eyes[1]))

    def are_human(self) -> bool:
        """Whether the irises are as large as a person's, and both."""
        sizes = self.iris / self.eye_distance
        in_range = IRIS_RANGE[0] < sizes.min() and sizes.max() < IRIS_RANGE[1]
        return bool(in_range and sizes.max() < IRIS_RATIO_MAX * sizes.min())


class PupilFinder:
    """Finds and keeps one viewer. `reason`: why the last picture gave nothing; `choice`: who it is."""

    def __init__(self, *, lock_ns: int = 0) -> None:
        """lock_ns: a viewer not seen for this long makes way for another."""
        self._faces, self._meshes, self._irises = FaceNetwork(), MeshNetwork(), IrisNetwork()
        self._flow, self._lock_ns = FaceFlow(), lock_ns
        self.viewer = 0  # counts up with every new one
        self.forget()

    def forget(self) -> None:
        """The next picture is the first."""
        self._looks: F64 | None = None  # of the viewer, whether followed or not
        self._last: _Look | None = None  # of the picture before, where the viewer was in it
        self._eyes = np.zeros((2, 2))  # px, as answered for the picture before
        self._steps = self._carried = 0  # pictures that went into them; since when one of them was not seen
        self._seen_ns = 0
        self.reason, self.choice = "", "nobody yet"

    def find(self, picture: U8, *, time_ns: int = 0) -> Pupils | None:
        """The viewer's pupils in an (h, w, 3) RGB picture, or None with the reason in `reason`."""
        if self._looks is not None and time_ns - self._seen_ns > self._lock_ns:
            self.forget()
            self.choice = "nobody: the viewer left"
        look, seen = self._follow(picture), "followed"
        if look is None:
            look, seen = self._search(picture), "found"
            self._steps = 0
        if look is None:
            self._last = None
            return None
        self.reason, self._seen_ns = "", time_ns
        return self._steadied(picture, look, "followed" if seen == "followed" else "found")

    def _follow(self, picture: U8) -> _Look | None:
        """The viewer, where the face was in the picture before."""
        if self._last is None or self._looks is None:
            return None
        last = self._last
        mesh, presence = self._meshes.points(picture, _square_of(last.mesh))
        if np.linalg.norm(mesh[BRIDGE, :2] - last.mesh[BRIDGE, :2]) > MOVED_FAR * last.eye_distance:
            mesh, presence = self._meshes.points(picture, _square_of(mesh))
        if presence < PRESENCE_FOLLOWED:
            return None
        look = self._measured(picture, mesh, presence)
        return look if look.looks @ self._looks > SAME_LOOKS_FOLLOWED else None

    def _search(self, picture: U8) -> _Look | None:
        """The viewer anywhere in the picture, or, where nobody is remembered, a new one."""
        found: list[FoundFace] = []
        for longest_px in LEVELS_PX:
            found = found or self._faces.find(picture, longest_px=longest_px, score_min=SCORE_MIN)
        self.reason = "no face"
        middle = np.array(picture.shape[1::-1]) / 2
        found.sort(key=lambda face: -_worth(face, middle))
        for face in found[:CANDIDATES_MAX]:
            mesh, presence = self._meshes.points(picture, face.square())
            if presence > PRESENCE_FOUND:
                mesh, presence = self._meshes.points(picture, _square_of(mesh))
            if presence < PRESENCE_FOUND:
                continue
            look = self._measured(picture, mesh, presence)
            if not look.are_human():
                self.reason = "a face without a person's eyes"
            elif self._looks is None:
                self.choice = f"locked on the foremost of {len(found)} face(s)"
                self.viewer += 1
                return look
            elif look.looks @ self._looks > SAME_LOOKS:
                return look
            else:
                self.reason = "another person's face"
        return None

    def _measured(self, picture: U8, mesh: F64, presence: float) -> _Look:
        eyes, iris, openness = np.zeros((2, 2)), np.zeros(2), np.zeros(2)
        for side, (first, second) in enumerate(CORNERS):
            line = mesh[second, :2] - mesh[first, :2]
            centre = (mesh[first, :2] + mesh[second, :2]) / 2
            square = Square(centre, float(EYE_SQUARE * np.abs(line).max()), float(np.arctan2(line[1], line[0])))
            points, lids = self._irises.points(picture, square, is_left=side == 0)
            eyes[side] = (points[0] + points[1:].mean(axis=0)) / 2
            iris[side] = (np.linalg.norm(points[1] - points[3]) + np.linalg.norm(points[2] - points[4])) / 2
            openness[side] = np.linalg.norm(lids[4] - lids[12]) / np.linalg.norm(lids[0] - lids[8])
        line = eyes[0] - eyes[1]
        eyes -= TOO_LOW * np.array([-line[1], line[0]])  # down the face, whichever way it is rolled
        return _Look(mesh, presence, eyes, iris, openness, _looks(picture, mesh, float(np.linalg.norm(line))))

    def _steadied(self, picture: U8, look: _Look, seen: Seen) -> Pupils:
        """The networks' pupils, carried along from the picture before where there is one."""
        eyes, surprise, hidden = look.eyes.copy(), np.zeros(2), np.zeros(2, bool)
        last = self._last if self._steps else None
        if last is not None:
            matrix = self._flow.moved(picture, look.mesh)
            if matrix is None:
                self._steps = 0
                matrix = _similarity(last.mesh, look.mesh)
            carried = transformed(matrix, self._eyes)
            off = (look.eyes - carried) / look.eye_distance
            surprise = np.linalg.norm(off, axis=1)
            if np.linalg.norm(off[0] - off[1]) > APART_MAX and self._carried < CARRIED_MAX:
                hidden = surprise == surprise.max()
            self._carried = self._carried + 1 if hidden.any() else 0
            turned = np.clip((surprise - GAZE_FROM) / (GAZE_FULL - GAZE_FROM), 0, 1)
            pull = np.minimum(np.maximum(PULL, 1 / (self._steps + 1)) + GAZE_PULL * turned, 1)
            pull[(look.openness < OPEN_MIN) | hidden] = 0
            eyes = carried + pull[:, None] * (look.eyes - carried)
        self._steps += 1
        self._remember(picture, look, eyes)
        distance = float(np.linalg.norm(eyes[0] - eyes[1]))
        surprised = SIGMA_SURPRISE * distance * float(np.minimum(surprise, GAZE_FULL).max())
        sigma = float(np.sqrt((SIGMA_PERSON * distance) ** 2 + SIGMA_PICTURE_PX**2 + surprised**2))
        side: Side = SIDES[int(np.argmax(hidden))] if hidden.any() else ""
        return Pupils(
            eyes, sigma, look.mesh, float(look.iris.mean()), "filled in" if side else seen, side, look.presence
        )

    def _remember(self, picture: U8, look: _Look, eyes: F64) -> None:
        looks = look.looks if self._looks is None else self._looks + LOOKS_PULL * (look.looks - self._looks)
        self._looks = looks / np.linalg.norm(looks)
        self._last, self._eyes = look, eyes
        self._flow.remember(picture, look.mesh, look.eye_distance)


def _worth(face: FoundFace, middle: F64) -> float:
    """What a face counts as the viewer's: its size, less where it is far from the picture's middle."""
    away = np.abs(face.box[:2] + face.box[2:] / 2 - middle) / middle
    return face.size * (1 - FARTHEST_OUT * float(np.linalg.norm(away) / np.sqrt(2)))


def _square_of(mesh: F64) -> Square:
    """The square that the mesh network looks at, from a mesh."""
    line = mesh[CORNERS[0][1], :2] - mesh[CORNERS[1][0], :2]
    angle = float(np.arctan2(line[1], line[0]))
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    upright = mesh[:, :2] @ turn
    low, high = upright.min(axis=0), upright.max(axis=0)
    return Square(turn @ ((low + high) / 2), float(FACE_SQUARE * (high - low).max()), angle)


def _looks(picture: U8, mesh: F64, eye_distance: float) -> F64:
    """(468,) grey values at the mesh's points, of mean 0 and length 1: one person's look much alike in every light."""
    margin = max(2, round(eye_distance / 4))
    height, width = picture.shape[:2]
    x0, y0 = np.clip(mesh[:, :2].min(axis=0).astype(int) - margin, 0, [width - 1, height - 1])
    x1, y1 = np.clip(mesh[:, :2].max(axis=0).astype(int) + margin, [x0 + 1, y0 + 1], [width, height])
    grey = cv2.cvtColor(np.ascontiguousarray(picture[y0:y1, x0:x1]), cv2.COLOR_RGB2GRAY)
    grey = cv2.GaussianBlur(grey, (0, 0), max(eye_distance / 16, 0.5)).astype(np.float32)
    x, y = (mesh[:, :2] - [x0 + 0.5, y0 + 0.5]).astype(np.float32).T
    values = cv2.remap(grey, x[:, None], y[:, None], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    looks = values.ravel().astype(np.float64)
    looks -= looks.mean()
    result: F64 = looks / max(float(np.linalg.norm(looks)), 1e-9)
    return result


def _similarity(last: F64, mesh: F64) -> F64:
    """(2, 3): how the eyes' corners moved."""
    corners = np.ravel(CORNERS)
    found, _ = cv2.estimateAffinePartial2D(last[corners, :2], mesh[corners, :2], method=cv2.LMEDS)
    return np.eye(2, 3) if found is None else np.asarray(found, np.float64)


@cache
def _still_finder() -> PupilFinder:
    return PupilFinder()


def find_eyes(picture: U8) -> Pupils | None:
    """The foremost viewer's pupils in an (h, w, 3) uint8 RGB picture; None where there is nobody."""
    finder = _still_finder()
    finder.forget()
    return finder.find(picture)
