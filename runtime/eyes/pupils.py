"""Follow one viewer's pupils from picture to picture and ignore other people."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal

import cv2
import numpy as np

from runtime.eyes.face_flow import BRIDGE, FaceFlow
from runtime.eyes.liveness import NEAR, OPEN_MIN, Liveness, Sign
from runtime.eyes.networks import FaceNetwork, FoundFace, IrisNetwork, MeshNetwork, Square, transformed
from runtime.records import F64, U8

Seen = Literal["found", "followed", "filled in"]
Side = Literal["", "left", "right"]
SIDES: tuple[Side, Side] = ("left", "right")

LEVELS_PX = (320, 640)  # longer side of the picture to search; the second value is tried if the first yields no face
SCORE_MIN = 0.8  # minimum face score; people in the dark at 1.5 m score 0.85, and most dogs score less than 0.8
PRESENCE_FOUND, PRESENCE_FOLLOWED = 0.9, 0.5  # minimum probability of a face in a new position, and in a known one
CANDIDATES_MAX = 4  # maximum number of faces to examine in a search for the viewer
FARTHEST_OUT = 0.7  # relative penalty for a face in a corner of the picture when the viewer is chosen
CORNERS = ((362, 263), (33, 133))  # mesh points at the corners of the left and the right eye
EYE_SQUARE = 2.7  # side of the iris network's input, in eye widths; the most accurate value between 1.8 and 3.1
FACE_SQUARE = 1.5  # side of the mesh network's input, relative to the face size
MOVED_FAR = 0.35  # the mesh network runs again after a movement of more than this, in eye separations

# A human iris measures 11.7 mm, and human eyes are 50 to 75 mm apart. These limits exclude dogs and monkeys.
IRIS_RANGE = (0.12, 0.33)  # diameter in eye separations; the separation looks shorter when the head turns
IRIS_RATIO_MAX = 1.4  # maximum ratio between the two irises' diameters
# The upper lid hides part of the iris, and the network returns the centre of the visible part. For any camera and
# distance, this centre is too low by the following share of the eye separation (0.6 mm). The share was fitted to all 51
# measured faces. If it is fitted to a random half of them, the error on the other half is 0.61 to 0.67 mm up to 1 m.
TOO_LOW = 0.0093

PULL = 0.1  # share of the deviation from the networks' estimate corrected with each picture
# When the gaze changes, the gain rises by up to GAZE_PULL as the deviation increases from GAZE_FROM to GAZE_FULL
# (in eye separations).
GAZE_FROM, GAZE_FULL, GAZE_PULL = 0.02, 0.06, 0.6
# Eyes turn together. If only one eye seems to turn by more than APART_MAX (in eye separations), it is hidden by a hand
# or hair, and the network is only guessing its position. Its pupil is then moved with the face for at most CARRIED_MAX
# pictures.
APART_MAX, CARRIED_MAX = 0.06, 30

SAME_LOOKS = 0.75  # minimum correlation between two views of one person; for 19 out of 20 other people, it is lower
SAME_LOOKS_FOLLOWED = 0.6  # minimum correlation for a face at the viewer's last position
LOOKS_PULL = 0.05  # rate of adapting the stored appearance to light and pose

# Contributions to a pupil's standard deviation along an axis: variation between people about the networks' mean
# (in eye separations), pixel noise (px), and the share of an unexpected change that is left after one picture.
SIGMA_PERSON, SIGMA_PICTURE_PX, SIGMA_SURPRISE = 0.0088, 0.14, 0.5


@dataclass(frozen=True, slots=True)
class Pupils:
    """One viewer's pupil positions in one picture, with the face mesh and the uncertainty."""

    eyes_px: F64  # (2, 2) left and right pupil in continuous pixels
    sigma_px: float  # standard deviation of one pupil along one axis
    mesh_px: F64  # (468, 3) face mesh points; z, also in pixels, points away from the camera
    iris_px: float  # mean iris diameter
    seen: Seen
    hidden: Side  # hidden eye, whose position is estimated from the rest of the face; empty: none
    certainty: float  # probability that this is a face

    @property
    def eye_distance_px(self) -> float:
        return float(np.linalg.norm(self.eyes_px[0] - self.eyes_px[1]))


@dataclass(frozen=True, slots=True)
class _Look:
    """The networks' estimates for one face in one picture."""

    mesh: F64  # (468, 3) face mesh points, px
    presence: float  # probability of a face
    eyes: F64  # (2, 2) left and right pupil, px
    iris: F64  # (2,) iris diameters, px
    openness: F64  # (2,) height-to-width ratios of the eyes
    looks: F64  # (468,) grey values at the mesh points, normalized to mean 0 and norm 1

    @property
    def eye_distance(self) -> float:
        return float(np.linalg.norm(self.eyes[0] - self.eyes[1]))

    @property
    def sign(self) -> Sign:
        """The face's sign of life."""
        return Sign(self.eyes.mean(axis=0), self.eye_distance, bool(self.openness.max() < OPEN_MIN), self.looks)

    def are_human(self) -> bool:
        """Return True if the irises are as large, and as similar to each other, as human irises."""
        sizes = self.iris / self.eye_distance
        in_range = IRIS_RANGE[0] < sizes.min() and sizes.max() < IRIS_RANGE[1]
        return bool(in_range and sizes.max() < IRIS_RATIO_MAX * sizes.min())


class PupilFinder:
    """Finder that follows one viewer's pupils from picture to picture. `viewer` is a number that
    increases with every new viewer, `reason` says why no pupils were found in the last picture, or "", and `choice` how
    the viewer was chosen.
    """

    def __init__(self, *, lock_ns: int = 0, shares: PupilFinder | None = None) -> None:
        """Create a finder, which may use another finder's networks. After `lock_ns`, a viewer who is no longer seen may
        be replaced by another person.
        """
        self._faces: FaceNetwork = shares._faces if shares else FaceNetwork()
        self._meshes: MeshNetwork = shares._meshes if shares else MeshNetwork()
        self._irises: IrisNetwork = shares._irises if shares else IrisNetwork()
        self._taken: Sequence[Sign] = ()
        self._flow, self._lock_ns = FaceFlow(), lock_ns
        self.viewer = self._found_count = 0
        self.forget()

    def forget(self) -> None:
        """Forget the viewer, and the pictures of faces. The next picture is treated as the first one."""
        self._liveness = Liveness()
        self._leave()

    def _leave(self) -> None:
        """Forget the viewer."""
        self._liveness.begin()
        self._looks: F64 | None = None  # appearance of the viewer's face, kept while it is out of sight
        self._last: _Look | None = None  # the viewer's estimates from the previous picture
        self._eyes = np.zeros((2, 2))  # pupils returned for the previous picture, px
        self._steps = self._carried = 0  # pictures averaged in `_eyes`; consecutive pictures with a hidden eye
        self._seen_ns = 0
        self.reason, self.choice = "", "no viewer yet"

    @property
    def sign(self) -> Sign | None:
        """The viewer's face in the last picture; None if it was not seen."""
        return None if self._last is None else self._last.sign

    @property
    def has_lived(self) -> bool:
        """True once the viewer has moved or blinked, which a picture on a wall does not."""
        return self._liveness.has_lived

    @property
    def is_free(self) -> bool:
        """True if no viewer is followed or remembered."""
        return self._looks is None

    def find(self, picture: U8, *, time_ns: int = 0, taken: Sequence[Sign] = ()) -> Pupils | None:
        """Return the viewer's pupils in an RGB picture of `time_ns`, or None and store the cause in `reason`.
        Faces in `taken` are left to other finders.
        """
        self._taken = taken
        if self._looks is not None and time_ns - self._seen_ns > self._lock_ns:
            self._leave()
            self.choice = "the viewer has left"
        look, seen = self._follow(picture), "followed"
        if look is None:
            look, seen = self._search(picture), "found"
            self._steps = 0
        if look is None:
            self._last = None
            return None
        if self._liveness.is_due(look.sign, time_ns) and (person := self._person(picture, look)) is not None:
            self._liveness.mark_viewer()
            self._leave()
            self.choice = "the face seen before neither moves nor blinks, so somebody who does is followed"
            self.viewer += 1
            look, seen = person, "found"
        self.reason, self._seen_ns = "", time_ns
        return self._steadied(picture, look, "followed" if seen == "followed" else "found")

    def _follow(self, picture: U8) -> _Look | None:
        """Look for the viewer where the face was in the previous picture."""
        if self._last is None or self._looks is None:
            return None
        last = self._last
        mesh, presence = self._meshes.points(picture, _square_of(last.mesh))
        if np.linalg.norm(mesh[BRIDGE, :2] - last.mesh[BRIDGE, :2]) > MOVED_FAR * last.eye_distance:
            mesh, presence = self._meshes.points(picture, _square_of(mesh))
        if presence < PRESENCE_FOLLOWED:
            return None
        look = self._measured(picture, mesh, presence)
        if self._is_taken(look):
            return None
        return look if look.looks @ self._looks > SAME_LOOKS_FOLLOWED else None

    def _is_taken(self, look: _Look) -> bool:
        """Return True if a face is one of those left to other finders."""
        return any(look.sign.apart(other) < NEAR for other in self._taken)

    def _person(self, picture: U8, viewer: _Look) -> _Look | None:
        """Return somebody other than the viewer who has moved or blinked since the previous call."""
        looks = [look for look in self._found(picture) if look.sign.apart(viewer.sign) > NEAR and look.are_human()]
        index = self._liveness.person_among([look.sign for look in looks])
        return None if index is None else looks[index]

    def _found(self, picture: U8) -> Iterator[_Look]:
        """Yield the faces in a picture, the most likely viewer first."""
        faces: list[FoundFace] = []
        for longest_px in LEVELS_PX:
            faces = faces or self._faces.find(picture, longest_px=longest_px, score_min=SCORE_MIN)
        faces = [face for face in faces if not any(_overlaps(face, other) for other in self._taken)]
        self._found_count = len(faces)
        middle = np.array(picture.shape[1::-1]) / 2
        faces.sort(key=lambda face: -_worth(face, middle))
        for face in faces[:CANDIDATES_MAX]:
            mesh, presence = self._meshes.points(picture, face.square())
            if presence > PRESENCE_FOUND:
                mesh, presence = self._meshes.points(picture, _square_of(mesh))
            if presence >= PRESENCE_FOUND and not self._is_taken(look := self._measured(picture, mesh, presence)):
                yield look

    def _search(self, picture: U8) -> _Look | None:
        """Search the whole picture for the viewer, or choose a new viewer if none is remembered."""
        self.reason = "no face"
        for look in self._found(picture):
            if not look.are_human():
                self.reason = "a face without a person's eyes"
            elif self._looks is None and self._liveness.is_picture(look.sign, alike=SAME_LOOKS):
                self.reason = "a face that neither moves nor blinks"
            elif self._looks is None:
                self.choice = f"following the foremost of {self._found_count} face(s)"
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
        eyes -= TOO_LOW * np.array([-line[1], line[0]])  # towards the chin, for any roll of the head
        return _Look(mesh, presence, eyes, iris, openness, _looks(picture, mesh, float(np.linalg.norm(line))))

    def _steadied(self, picture: U8, look: _Look, seen: Seen) -> Pupils:
        """Return pupils with less jitter: the previous ones, moved with the face, corrected towards the networks'."""
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
        self._looks = _unit(looks)
        self._last, self._eyes = look, eyes
        self._flow.remember(picture, look.mesh, look.eye_distance)


def _worth(face: FoundFace, middle: F64) -> float:
    """Return a face's score as a possible viewer: its size, reduced away from the picture's `middle` (2,)."""
    away = np.abs(face.box[:2] + face.box[2:] / 2 - middle) / middle
    return face.size * (1 - FARTHEST_OUT * float(np.linalg.norm(away) / np.sqrt(2)))


def _overlaps(face: FoundFace, sign: Sign) -> bool:
    """Return True if the midpoint between a person's pupils is in a found face's box."""
    return bool((face.box[:2] < sign.middle).all() and (sign.middle < face.box[:2] + face.box[2:]).all())


def _square_of(mesh: F64) -> Square:
    """Return the square around a known face mesh, to be used as the mesh network's next input."""
    line = mesh[CORNERS[0][1], :2] - mesh[CORNERS[1][0], :2]
    angle = float(np.arctan2(line[1], line[0]))
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    upright = mesh[:, :2] @ turn
    low, high = upright.min(axis=0), upright.max(axis=0)
    return Square(turn @ ((low + high) / 2), float(FACE_SQUARE * (high - low).max()), angle)


def _looks(picture: U8, mesh: F64, eye_distance: float) -> F64:
    """Return the (468,) grey values at mesh points, of mean 0 and norm 1, which describe a person's appearance."""
    margin = max(2, round(eye_distance / 4))
    height, width = picture.shape[:2]
    x0, y0 = np.clip(mesh[:, :2].min(axis=0).astype(int) - margin, 0, [width - 1, height - 1])
    x1, y1 = np.clip(mesh[:, :2].max(axis=0).astype(int) + margin, [x0 + 1, y0 + 1], [width, height])
    grey = cv2.cvtColor(np.ascontiguousarray(picture[y0:y1, x0:x1]), cv2.COLOR_RGB2GRAY)
    grey = cv2.GaussianBlur(grey, (0, 0), max(eye_distance / 16, 0.5)).astype(np.float32)
    x, y = (mesh[:, :2] - [x0 + 0.5, y0 + 0.5]).astype(np.float32).T
    values = cv2.remap(grey, x[:, None], y[:, None], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    looks = values.ravel().astype(np.float64)
    return _unit(looks - looks.mean())


def _unit(looks: F64) -> F64:
    """Return looks of norm 1, or zeros where a face has no contrast."""
    unit: F64 = looks / max(float(np.linalg.norm(looks)), 1e-9)
    return unit


def _similarity(last: F64, mesh: F64) -> F64:
    """Return the (2, 3) similarity that maps the eye corners in the mesh `last` to those in `mesh`."""
    corners = np.ravel(CORNERS)
    matrix, _ = cv2.estimateAffinePartial2D(last[corners, :2], mesh[corners, :2], method=cv2.LMEDS)
    return np.eye(2, 3) if matrix is None else np.asarray(matrix, np.float64)


@cache
def _still_finder() -> PupilFinder:
    return PupilFinder()


def find_eyes(picture: U8) -> Pupils | None:
    """Return the foremost viewer's pupils in an (h, w, 3) RGB picture, or None if there is no viewer."""
    finder = _still_finder()
    finder.forget()
    return finder.find(picture)
