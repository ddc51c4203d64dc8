"""Tests how pupils are chosen, averaged and followed, with drawn faces and networks that report what was drawn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import pytest

from runtime.eyes import pupils
from runtime.eyes.liveness import Sign
from runtime.eyes.networks import FoundFace, Square
from runtime.eyes.pupils import CORNERS, PupilFinder, Pupils
from runtime.records import F64, U8

TEMPLATE = np.random.default_rng(1).uniform(-0.9, 0.9, (468, 2))  # mesh points, in eye separations
HEIGHT, WIDTH = 480, 640
SIGMA_PX = 0.546  # of a face whose eyes are 60 pixels apart, without any surprise


@dataclass(frozen=True)
class Face:
    """A face in the picture, and what the networks find of it."""

    x: float = 320.0
    y: float = 240.0
    apart: float = 60.0
    roll: float = 0.0
    person: int = 0
    alike: float = 1.0  # correlation of its appearance with that person's
    presence: float = 0.99
    score: float = 0.95
    irises: tuple[float, float] = (0.2, 0.2)  # diameters, in eye separations
    openness: tuple[float, float] = (0.3, 0.3)
    gaze: tuple[float, float] = (0.0, 0.0)  # each pupil's shift to the right, in eye separations
    longest_px: int = 320  # of the picture that it is found in

    @property
    def turn(self) -> F64:
        c, s = np.cos(self.roll), np.sin(self.roll)
        return np.array([[c, -s], [s, c]])

    def placed(self, points: Any) -> F64:
        """Points in eye separations about the middle between the eyes, in pixels."""
        return np.array([self.x, self.y]) + self.apart * np.asarray(points) @ self.turn.T

    def mesh(self) -> F64:
        points = TEMPLATE.copy()
        points[pupils.BRIDGE] = 0.0
        for x, corners in zip((0.5, -0.5), CORNERS, strict=True):
            points[list(corners)] = [[x - 0.2, 0.0], [x + 0.2, 0.0]]
        return np.column_stack([self.placed(points), np.zeros(468)])


def drawn(*faces: Face) -> U8:
    picture = np.full((HEIGHT, WIDTH), 128.0, np.float32)
    for face in faces:
        own, other = (np.random.default_rng(seed).normal(0.0, 30.0, (12, 12)) for seed in (face.person, 99))
        texture = np.asarray(face.alike * own + np.sqrt(1 - face.alike**2) * other, np.float32)
        scale = 2.4 * face.apart / 12
        corner = face.placed([-1.2, -1.2])
        matrix = np.column_stack([face.turn * scale, corner])
        patch = cv2.warpAffine(texture, matrix, (WIDTH, HEIGHT), flags=cv2.INTER_CUBIC)
        inside = cv2.warpAffine(np.ones((12, 12), np.float32), matrix, (WIDTH, HEIGHT), flags=cv2.INTER_NEAREST) > 0
        picture[inside] = 128 + patch[inside]
    return np.repeat(np.clip(np.rint(picture), 0, 255).astype(np.uint8)[..., None], 3, axis=2)


class Networks:
    """Stands for the three networks, which see `faces`."""

    def __init__(self) -> None:
        self.faces: Sequence[Face] = ()
        self.meshes = 0  # how often the mesh was asked for

    def near(self, centre: F64) -> Face:
        return min(self.faces or [Face(presence=0.0)], key=lambda face: np.hypot(*(face.placed([0, 0]) - centre)))

    def find(self, picture: U8, *, longest_px: int, score_min: float) -> list[FoundFace]:
        found = []
        for face in self.faces:
            if face.score > score_min and longest_px >= face.longest_px:
                box = np.array([face.x - face.apart, face.y - face.apart, 2 * face.apart, 2 * face.apart])
                points = face.placed([(-0.5, 0), (0.5, 0), (0, 0.5), (-0.4, 1), (0.4, 1)])
                found.append(FoundFace(face.score, box, points))
        return found

    def points(self, picture: U8, square: Square, *, is_left: bool | None = None) -> tuple[Any, Any]:
        face = self.near(square.centre)
        self.meshes += is_left is None
        if is_left is None:
            return face.mesh(), face.presence
        side = 0 if is_left else 1
        middle, radius = np.array([(0.5, -0.5)[side] + face.gaze[side], 0.0]), face.irises[side] / 2
        iris = face.placed([middle + radius * np.array(way) for way in ((0, 0), (1, 0), (0, -1), (-1, 0), (0, 1))])
        lids = np.zeros((16, 2))
        lids[0], lids[8], lids[4], lids[12] = (-1, 0), (1, 0), (0, face.openness[side]), (0, -face.openness[side])
        return iris, lids


class Film:
    """A finder that looks at one picture after the other, 30 a second."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.networks, self.number = Networks(), 0
        for name in ("FaceNetwork", "MeshNetwork", "IrisNetwork"):
            monkeypatch.setattr(pupils, name, lambda: self.networks)
        self.finder = PupilFinder(lock_ns=10**9)

    def see(self, *faces: Face, count: int = 1, taken: Sequence[Sign] = ()) -> Pupils | None:
        self.networks.faces, picture = faces, drawn(*faces)
        for _ in range(count):
            found = self.finder.find(picture, time_ns=self.number * 33_333_333, taken=taken)
            self.number += 1
        return found


@pytest.fixture
def film(monkeypatch: pytest.MonkeyPatch) -> Film:
    return Film(monkeypatch)


@pytest.mark.parametrize("face", [Face(), Face(x=200, y=150, apart=40), Face(roll=0.5), Face(roll=-0.8, apart=90)])
def test_pupils_are_raised_by_0_6_mm_on_the_face(film: Film, face: Face) -> None:
    found = film.see(face)
    assert found is not None
    np.testing.assert_allclose(found.eyes_px, face.placed([(0.5, -0.0093), (-0.5, -0.0093)]), atol=1e-6)
    assert (found.seen, found.hidden, found.certainty) == ("found", "", 0.99)
    assert found.iris_px == pytest.approx(0.2 * face.apart) and found.eye_distance_px == pytest.approx(face.apart)
    assert found.sigma_px == pytest.approx(np.hypot(0.0088 * face.apart, 0.14), rel=1e-3)


@pytest.mark.parametrize(("pictures", "gaze", "moved_px", "sigma_px"), [
    (1, 0.01, 0.3, 0.62), (3, 0.01, 0.15, 0.62), (15, 0.01, 0.06, 0.62), (15, -0.01, -0.06, 0.62),
    (15, 0.02, 0.12, 0.81), (15, 0.04, 0.96, 1.32), (15, 0.06, 2.52, 1.88), (15, 0.10, 4.2, 1.88),
])  # fmt: skip
def test_pupils_are_averaged_unless_the_gaze_turns(
    film: Film, pictures: int, gaze: float, moved_px: float, sigma_px: float
) -> None:
    """Half of a deviation counts at first, and a tenth in the end."""
    still = film.see(Face(), count=pictures)
    turned = film.see(Face(gaze=(gaze, gaze)))
    assert still is not None and turned is not None and turned.seen == "followed"
    np.testing.assert_allclose(turned.eyes_px - still.eyes_px, [[moved_px, 0.0]] * 2, atol=0.02)
    assert still.sigma_px == pytest.approx(SIGMA_PX, abs=0.005)
    assert turned.sigma_px == pytest.approx(sigma_px, abs=0.02)


@pytest.mark.parametrize("apart", [60.0, 100.0])
def test_looks_are_the_blurred_grey_values_at_the_mesh_s_points(film: Film, apart: float) -> None:
    """A wave of w radians per pixel keeps exp(-s² w² / 2) of its height in a blur by s, a 16th of the separation."""
    face, waves = Face(apart=apart), ((0.15, 0.1), (-0.05, 0.2))

    def grey(x: F64, y: F64, blur_px: float = 0.0) -> F64:
        return np.asarray(sum(60 * np.sin(u * x + v * y) * np.exp(-(u**2 + v**2) * blur_px**2 / 2) for u, v in waves))

    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    film.networks.faces = (face,)
    film.finder.find(np.repeat(np.rint(128 + grey(columns, rows)).astype(np.uint8)[..., None], 3, axis=2))
    expected = grey(*face.mesh()[:, :2].T, blur_px=apart / 16)
    expected -= expected.mean()
    assert film.finder.sign is not None
    np.testing.assert_allclose(film.finder.sign.looks, expected / np.linalg.norm(expected), atol=0.002)
    for x, y in ((-400.0, 240.0), (1100.0, 240.0), (320.0, -300.0), (320.0, 900.0), (640.0, 480.0)):  # edge and beyond
        film.finder.forget()
        assert film.see(Face(x=x, y=y)) is not None and np.isfinite(film.finder.sign.looks).all()


def test_averaged_pupils_move_with_the_face(film: Film) -> None:
    film.see(Face(), count=15)
    for face in (Face(x=323.5, y=238.0), Face(x=326.0, y=237.0, roll=0.05)):
        found = film.see(face)
        assert found is not None and found.seen == "followed" and found.sigma_px < 0.6
        np.testing.assert_allclose(found.eyes_px, face.placed([(0.5, -0.0093), (-0.5, -0.0093)]), atol=0.2)
    before = film.networks.meshes
    for x, count in ((346.9, 1), (368.0, 3)):  # far from where it was, by more than 21 pixels, it is measured twice
        assert film.see(Face(x=x, y=237.0)) is not None and film.networks.meshes - before == count


@pytest.mark.parametrize(
    ("gaze", "hidden"), [((0.063, 0), ""), ((0.0645, 0), "left"), ((0, -0.0645), "right"), ((0.2, 0.2), "")]
)
def test_an_eye_that_turns_alone_is_hidden_for_30_pictures(film: Film, gaze: tuple[float, float], hidden: str) -> None:
    still = film.see(Face(), count=15)
    told = [film.see(Face(gaze=gaze)) for _ in range(31)]
    assert still is not None and [one is not None and one.hidden for one in told] == [hidden] * 30 + [""]
    assert told[0] is not None and told[29] is not None and told[0].seen == ("filled in" if hidden else "followed")
    if hidden:
        np.testing.assert_allclose(told[29].eyes_px, still.eyes_px, atol=0.1)


def test_the_pupil_of_a_closed_eye_moves_with_the_face_alone(film: Film) -> None:
    still = film.see(Face(), count=15)
    half = film.see(Face(gaze=(0.05, 0.05), openness=(0.119, 0.121)))
    assert still is not None and half is not None and half.hidden == ""
    np.testing.assert_allclose((half.eyes_px - still.eyes_px)[:, 0], [0.0, 0.55 * 3], atol=0.03)


ANIMAL = "a face without a person's eyes"


@pytest.mark.parametrize(("face", "reason"), [
    (Face(irises=(0.121, 0.121)), ""), (Face(irises=(0.119, 0.13)), ANIMAL), (Face(irises=(0.329, 0.329)), ""),
    (Face(irises=(0.331, 0.32)), ANIMAL), (Face(irises=(0.2, 0.279)), ""), (Face(irises=(0.2, 0.281)), ANIMAL),
    (Face(irises=(0.281, 0.2)), ANIMAL), (Face(presence=0.9), ""), (Face(presence=0.899), "no face"),
    (Face(score=0.801), ""), (Face(score=0.8), "no face"), (Face(longest_px=640), ""),
    (Face(longest_px=641), "no face"),
])  # fmt: skip
def test_only_a_person_is_a_viewer(film: Film, face: Face, reason: str) -> None:
    assert (film.see(face) is None) == bool(reason) and film.finder.reason == reason
    assert film.finder.viewer == (not reason) and film.finder.is_free == bool(reason)
    assert film.finder.choice == ("no viewer yet" if reason else "following the foremost of 1 face(s)")


@pytest.mark.parametrize(("face", "is_followed", "is_found_again"), [
    (Face(presence=0.5), True, False), (Face(presence=0.49), False, False), (Face(alike=0.8), True, True),
    (Face(alike=0.68), True, False), (Face(alike=0.5), False, False), (Face(x=360), True, True),
])  # fmt: skip
def test_a_viewer_is_followed_more_readily_than_found_again(
    film: Film, face: Face, is_followed: bool, is_found_again: bool
) -> None:
    film.see(Face(), count=3)
    found = film.see(face)
    assert (found is not None) == is_followed and (found is None or found.seen == "followed")
    film.finder.forget()
    film.see(Face(), count=3)
    assert film.see() is None and film.finder.reason == "no face" and film.finder.sign is None
    again = film.see(face)
    assert (again is not None) == is_found_again and (again is None or again.seen == "found")
    assert film.finder.viewer == 2


@pytest.mark.parametrize(("apart", "chosen"), [(60, 0), (84, 0), (85, 1)])
def test_a_face_in_a_corner_must_be_twice_as_large(film: Film, apart: float, chosen: int) -> None:
    faces = Face(apart=40.0), Face(x=560.0, y=60.0, apart=apart, person=1)
    found = film.see(*faces)
    assert found is not None and np.allclose(found.eyes_px.mean(axis=0)[0], faces[chosen].x)
    assert film.finder.choice == "following the foremost of 2 face(s)"


@pytest.mark.parametrize(("dogs", "is_found"), [(3, True), (4, False)])
def test_the_four_foremost_faces_are_examined(film: Film, dogs: int, is_found: bool) -> None:
    dog = Face(y=240, apart=40.0, irises=(0.4, 0.4))
    faces = [replace(dog, x=100.0 + 110 * n, person=n) for n in range(dogs)]
    found = film.see(*faces, Face(x=580.0, y=440.0, apart=20.0, person=9))
    assert (found is not None) == is_found and film.finder.reason == ("" if is_found else ANIMAL)


def test_faces_of_others_are_left_to_them(film: Film) -> None:
    looks = np.zeros(468)
    here, beside = (Sign(np.array([x, 240.0]), 60.0, False, looks) for x in (320.0, 420.0))
    assert film.see(Face(), taken=[here]) is None and film.finder.reason == "no face"
    assert film.see(Face(), taken=[beside]) is not None
    assert film.see(Face(), taken=[here]) is None
