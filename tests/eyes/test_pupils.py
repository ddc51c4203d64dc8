"""Tests that pupils of real faces are found and followed steadily, and only the viewer's."""

from __future__ import annotations

import hashlib

import cv2
import numpy as np
import pytest
import skimage.data

from runtime.eyes.networks import MODELS, FaceNetwork, MeshNetwork, Square, resampled
from runtime.eyes.pupils import PupilFinder, find_eyes
from tests.eyes.scene import Portrait, camera, eileen, grace, scene

CAMERA = camera(640, 480, 65.0)
FOCAL = CAMERA.fx_px
PERIOD_NS = 33_333_333


def pixels(eyes_m: np.ndarray) -> np.ndarray:
    return eyes_m[:, :2] / eyes_m[:, 2:] * FOCAL + [CAMERA.cx_px, CAMERA.cy_px]


def test_the_models_are_those_that_were_shipped() -> None:
    lines = (MODELS / "SHA256SUMS").read_text().splitlines()
    sums = {name: digest for digest, name in map(str.split, lines)}
    assert sums == {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in MODELS.glob("*.onnx")}


@pytest.mark.parametrize("portrait", [eileen(), grace()], ids=["eileen", "grace"])
@pytest.mark.parametrize("distance_m", [0.5, 0.75, 1.0, 1.5])
@pytest.mark.parametrize("light", [1.0, 0.25])
def test_pupils_are_found_to_1_5_mm_and_sigma_is_true(portrait: Portrait, distance_m: float, light: float) -> None:
    place = np.array([0.05, -0.02, distance_m])
    colour, _, (truth,) = scene(place, intrinsics=CAMERA, portraits=(portrait,), noise=2)
    found = find_eyes((colour * light).astype(np.uint8))
    assert found is not None and found.seen == "found"
    error = found.eyes_px - pixels(truth)  # the left eye first, on the right of the picture
    assert np.abs(error).max() * distance_m / FOCAL < 0.0018
    assert 0.5 * found.sigma_px < np.sqrt(np.mean(error**2)) + 0.25 * found.sigma_px
    assert np.abs(error).max() < 3.5 * found.sigma_px


@pytest.mark.parametrize("roll_deg", [-30, 20])
def test_a_rolled_head_is_found_as_well(roll_deg: float) -> None:
    colour, _, (truth,) = scene(np.array([0, 0, 0.6]), intrinsics=CAMERA)
    turn = cv2.getRotationMatrix2D((320 - 0.5, 240 - 0.5), roll_deg, 1.0)
    found = find_eyes(cv2.warpAffine(colour, turn, (640, 480)))
    expected = (pixels(truth) - 0.5) @ turn[:, :2].T + turn[:, 2] + 0.5
    assert np.abs(found.eyes_px - expected).max() * 0.6 / FOCAL < 0.002


@pytest.mark.parametrize("name", ["chelsea", "coffee", "rocket", "moon", "horse", "brick", "clock", "coins"])
def test_where_nobody_is_nobody_is_seen(name: str) -> None:
    picture = getattr(skimage.data, name)()
    if picture.dtype == bool:
        picture = picture.astype(np.uint8) * 255
    assert find_eyes(picture if picture.ndim == 3 else np.repeat(picture[..., None], 3, axis=2)) is None


def followed(finder: PupilFinder, places: np.ndarray, **how: tuple[Portrait, ...]) -> np.ndarray:
    """(n, 2, 2) px errors of the first viewer's pupils along (n, 3) m; NaN where they are not seen."""
    errors = np.full((len(places), 2, 2), np.nan)
    for number, place in enumerate(places):
        colour, _, (truth,) = scene(place, intrinsics=CAMERA, noise=3, seed=number, **how)
        found = finder.find(colour, time_ns=number * PERIOD_NS)
        if found is not None:
            assert found.seen == ("followed" if number else "found")
            errors[number] = found.eyes_px - pixels(truth)
    return errors


def test_a_moving_face_is_followed_without_jitter_or_lag() -> None:
    time_s = np.arange(40) / 30
    places = np.column_stack([0.03 * np.sin(4 * time_s), 0.01 * np.cos(5 * time_s), np.full(40, 0.75)])
    errors = followed(PupilFinder(lock_ns=10**9), places)[5:] * 0.75 / FOCAL
    assert errors.std(axis=0).mean() < 0.00007
    speed = np.gradient(places[:, 0])[5:]  # m a frame
    lag = -np.polyfit(speed, errors.mean(axis=1)[:, 0], 1)[0]
    assert abs(lag) < 0.1


def test_another_person_who_passes_in_front_is_not_the_viewer() -> None:
    finder, seen = PupilFinder(lock_ns=10**9), []
    for number in range(26):
        passer_by = np.array([-0.4 + number * 0.03, 0.0, 0.5])
        colour, _, truth = scene(np.array([0.0, 0.0, 0.8]), passer_by, intrinsics=CAMERA, portraits=(grace(), eileen()))
        if number == 0:  # the viewer is there before anybody comes
            colour, _, truth = scene(np.array([0.0, 0.0, 0.8]), intrinsics=CAMERA, portraits=(grace(),))
        found = finder.find(colour, time_ns=number * PERIOD_NS)
        seen.append(found is not None)
        if found is not None:  # never the passer-by's, and nothing between the two
            assert np.abs(found.eyes_px - pixels(truth[0])).max() * 0.8 / FOCAL < 0.006
    assert not all(seen[10:18]) and all(seen[-2:]) and finder.viewer == 1


def test_another_viewer_is_taken_once_the_first_is_gone_long_enough() -> None:
    finder = PupilFinder(lock_ns=9 * PERIOD_NS)  # not yet over when unseen for as long
    here = np.array([0.0, 0.0, 0.7])
    for number in range(14):
        who = grace() if number < 2 else eileen()
        colour, _, _ = scene(here, intrinsics=CAMERA, portraits=(who,))
        found = finder.find(colour, time_ns=number * PERIOD_NS)
        assert (found is not None) == (number < 2 or number > 10), number
        assert finder.reason == ("another person's face" if found is None else "")
    assert finder.viewer == 2


def test_the_foremost_of_two_is_the_viewer() -> None:
    places = np.array([-0.15, 0.0, 0.6]), np.array([0.2, 0.0, 0.9])
    colour, _, truth = scene(*places, intrinsics=CAMERA, portraits=(grace(), eileen()))
    assert np.abs(find_eyes(colour).eyes_px - pixels(truth[1])).max() < 3


def test_a_hidden_eye_is_carried_along_and_labelled() -> None:
    finder = PupilFinder(lock_ns=10**9)
    for number in range(12):
        place = np.array([0.002 * number, 0.0, 0.6])
        colour, _, (truth,) = scene(place, intrinsics=CAMERA)
        left, right = pixels(truth)
        if number > 5:  # a hand before the left eye
            radius = 0.45 * np.linalg.norm(left - right)
            cv2.circle(colour, tuple(int(x) for x in left), int(radius), (190, 150, 130), -1)
        found = finder.find(colour, time_ns=number * PERIOD_NS)
        if number > 5:
            assert found.seen == "filled in" and found.hidden == "left"
            assert np.abs(found.eyes_px - [left, right]).max() * 0.6 / FOCAL < 0.004


def test_a_picture_of_any_size_and_shape_is_looked_at() -> None:
    for shape in ((1, 1), (3, 2000), (2000, 3), (40, 40)):
        assert find_eyes(np.zeros((*shape, 3), np.uint8)) is None
    _, presence = MeshNetwork().points(np.full((64, 64, 3), 120, np.uint8), Square(np.full(2, 32.0), 64.0, 0.0))
    assert 0.0 < presence < 0.5


def two(number: int, *, wall_moves: bool, person_moves: bool) -> np.ndarray:
    """Pictures of a small face on the wall, and from the fifth second on a larger one in front of it."""
    sway = 0.012 * np.sin(number / 2)
    wall = np.array([-0.45 + sway * wall_moves, 0.0, 1.4])
    person = np.array([0.12 + sway * person_moves, 0.0, 0.6])
    places, portraits = ((wall, person), (grace(), eileen())) if number >= 25 else ((wall,), (grace(),))
    return scene(*places, intrinsics=CAMERA, portraits=portraits, noise=2, seed=number)[0]


def whose(**moves: bool) -> list[str]:
    finder, seen = PupilFinder(lock_ns=10**9), []
    for number in range(75):
        found = finder.find(two(number, **moves), time_ns=number * 200_000_000)
        assert found is not None
        seen.append("wall" if found.eyes_px[0, 0] < 320 else "person")
    return seen


def test_a_face_on_the_wall_gives_way_to_who_alone_moves() -> None:
    seen = whose(wall_moves=False, person_moves=True)
    assert seen[0] == "wall" and seen[30] == "wall" and set(seen[-25:]) == {"person"}
    assert set(whose(wall_moves=True, person_moves=True)) == {"wall"}
    assert set(whose(wall_moves=False, person_moves=False)) == {"wall"}


def test_a_face_on_the_wall_is_not_taken_again_unless_it_moves() -> None:
    finder = PupilFinder(lock_ns=10**9)
    for number in range(60):
        finder.find(two(number, wall_moves=False, person_moves=True), time_ns=number * 200_000_000)
    for number in range(60, 75):  # the person has left
        found = finder.find(two(0, wall_moves=False, person_moves=True), time_ns=number * 200_000_000)
    assert found is None and finder.reason == "a face that neither moves nor blinks"
    moved = scene(np.array([-0.40, 0.0, 1.4]), intrinsics=CAMERA, portraits=(grace(),))[0]
    assert finder.find(moved, time_ns=76 * 200_000_000) is not None


@pytest.mark.parametrize(("scale", "centre", "off"), [
    (1.0, (60.0, 40.0), 1.0), (0.9, (5.0, 75.0), 1.0), (1.6, (118.0, 3.0), 1.0), (1.0, (400.0, 40.0), 1.0),
    (1.0, (60.0, -300.0), 1.0), (0.4, (60.0, 40.0), 4.0), (0.25, (10.0, 300.0), 4.0),
])  # fmt: skip
def test_a_crop_is_the_picture_turned_edges_repeated(scale: float, centre: tuple[float, float], off: float) -> None:
    def wave(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.asarray(128 + 100 * np.sin(x / 25) * np.cos(y / 30))

    rows, columns = np.mgrid[0:80, 0:120] + 0.5
    picture = np.repeat(np.rint(wave(columns, rows)).astype(np.uint8)[..., None], 3, axis=2)
    turn = scale * np.array([[0.8, -0.6], [0.6, 0.8]])
    matrix = np.column_stack([turn, [20.0, 16.0] - turn @ centre])
    v, u = np.mgrid[0:32, 0:40] + 0.5
    x, y = np.linalg.inv(turn) @ (np.stack([u.ravel(), v.ravel()]) - matrix[:, 2:])
    expected = wave(np.clip(x, 0.5, 119.5), np.clip(y, 0.5, 79.5)).reshape(32, 40)
    assert np.abs(resampled(picture, (40, 32), matrix)[..., 1] - expected).max() < off + 0.6


def test_a_large_picture_is_reduced_before_faces_are_searched() -> None:
    """Pixels enlarged fourfold and reduced again are the same, so the network finds the same in them."""
    picture = np.ascontiguousarray(skimage.data.astronaut()[:300, 60:420])
    faces = FaceNetwork()
    (face,) = faces.find(picture, longest_px=360, score_min=0.6)
    (enlarged,) = faces.find(picture.repeat(4, axis=0).repeat(4, axis=1), longest_px=360, score_min=0.6)
    assert enlarged.score == face.score > 0.8 and enlarged.size == pytest.approx(4 * face.size)
    for big, small in ((enlarged.box, face.box), (enlarged.points, face.points)):
        np.testing.assert_allclose(big, 4 * small, rtol=1e-9)
    assert ((face.box[:2] < face.points) & (face.points < face.box[:2] + face.box[2:])).all()
    assert np.ptp(face.points[:2, 0]) / face.size == pytest.approx(0.4, abs=0.15)  # of the eyes, to the face
