"""Tests the distance of the eyes with faulty depth, and without depth."""

from __future__ import annotations

import numpy as np
import pytest

from runtime.config import Settings
from runtime.eyes.detect import EyeFinder, covariance
from runtime.eyes.face_depth import EyeDepths, FaceDepth
from runtime.eyes.face_flow import RIGID
from runtime.eyes.pupils import CORNERS, Pupils
from runtime.records import U16, Intrinsics, SensorFrame
from tests.eyes.scene import IPD_M, camera, frame, scene

CAMERA = camera(640, 480, 65.0)
PLACE = np.array([0.04, 0.02, 0.7])


@pytest.mark.parametrize("depth_size", [None, (320, 240)])
def test_eyes_are_found_in_space_to_some_millimetres_at_every_place(depth_size: tuple[int, int] | None) -> None:
    for place in ((0.0, 0.0, 0.4), (0.0, 0.0, 1.5), (0.1, 0.05, 0.6), (-0.25, -0.1, 0.9), (0.3, 0.1, 1.4)):
        colour, depth, (truth,) = scene(np.array(place), intrinsics=CAMERA, depth_size=depth_size)
        finder = EyeFinder()
        for number in (1, 2, 3):
            found = finder.find(frame(colour, depth, CAMERA, number=number))
        assert found is not None and np.abs(found.eyes_m - truth).max() < 0.005
        assert found.confidence.shape == (2,) and 0.9 < found.confidence.min() <= found.confidence.max() <= 1.0
        assert found.eyes_m[0, 0] > found.eyes_m[1, 0]  # the left one is on the right of an unmirrored picture
        assert found.covariance_m2 is not None and finder.pupils is not None
        sigmas_px = np.sqrt(found.covariance_m2.diagonal()[:2]) / place[2] * CAMERA.fx_px / finder.pupils.sigma_px
        np.testing.assert_allclose(sigmas_px, [0.55, 1.1], rtol=0.02 if place[:2] == (0.0, 0.0) else 0.8)
    colour, depth, (truth,) = scene(PLACE, intrinsics=CAMERA, depth_size=depth_size)
    first = EyeFinder().find(frame(colour, depth, CAMERA))
    assert np.abs(first.eyes_m - truth).max() < (0.005 if depth_size else 0.012)


def faulty(depth: np.ndarray, seed: int, *, holes: float, flying: float, noise_mm: float) -> np.ndarray:
    random = np.random.default_rng(seed)
    noisy = np.clip(depth + random.normal(0, noise_mm, depth.shape), 1, 60_000).astype(np.uint16)
    noisy[random.random(depth.shape) < holes] = 0
    is_flying = random.random(depth.shape) < flying
    noisy[is_flying] = (noisy[is_flying] + random.uniform(100, 1500, is_flying.sum())).astype(np.uint16)
    return noisy


def test_noise_holes_and_flying_pixels_hardly_move_the_eyes() -> None:
    colour, depth, (truth,) = scene(PLACE, intrinsics=CAMERA)
    finder, errors, sigmas = EyeFinder(), [], []
    for number in range(30):
        bad = faulty(depth, number, holes=0.4, flying=0.15, noise_mm=5)
        found = finder.find(frame(colour, bad, CAMERA, number=number))
        errors.append(found.eyes_m.mean(axis=0)[2] - truth[:, 2].mean())
        sigmas.append(np.sqrt(found.covariance_m2[2, 2]))
    assert np.abs(errors[5:]).max() < 0.005
    assert np.std(errors[10:]) < 0.0012  # a quarter of one pixel's noise
    assert np.abs(errors).max() < 3 * max(sigmas) and np.mean(np.abs(errors)) > 0.1 * np.mean(sigmas)


@pytest.mark.parametrize("glasses_mm", [0, 60, 400], ids=["holes", "the lens", "what it mirrors"])
def test_what_glasses_do_to_depth_does_not_reach_the_eyes(glasses_mm: int) -> None:
    colour, depth, (truth,) = scene(PLACE, intrinsics=CAMERA)
    for u, v in truth[:, :2] / truth[:, 2:] * CAMERA.fx_px + [CAMERA.cx_px, CAMERA.cy_px]:
        around = np.s_[int(v) - 9 : int(v) + 9, int(u) - 11 : int(u) + 11]
        depth[around] = depth[around] + glasses_mm if glasses_mm else 0
    found = EyeFinder().find(frame(colour, depth, CAMERA))
    assert np.abs(found.eyes_m[:, 2].mean() - truth[0, 2]) < 0.012
    assert np.sqrt(found.covariance_m2[2, 2]) > 0.003  # nobody measured at the eyes themselves


def test_depth_that_stops_is_bridged_by_this_viewers_eye_distance() -> None:
    finder, sigmas = EyeFinder(), []
    for number in range(30):
        colour, depth, (truth,) = scene(PLACE + np.array([0, 0, 0.004 * number]), intrinsics=CAMERA)
        found = finder.find(frame(colour, depth * (number < 10), CAMERA, number=number))
        assert np.abs(found.eyes_m[:, 2] - truth[:, 2]).max() < 0.009
        sigmas.append(np.sqrt(found.covariance_m2[2, 2]))
    assert sigmas[-1] > sigmas[9]


@pytest.mark.parametrize("has_depth", [False, True])
@pytest.mark.parametrize("place", [(0.3, 0.05, 0.6), (-0.2, -0.25, 0.6), (0.12, 0.0, 0.6), (0.0, 0.0, 0.6)])
def test_an_off_centre_head_s_eyes_lie_across_its_line_of_sight(
    place: tuple[float, float, float], has_depth: bool
) -> None:
    """A head that looks into the camera: one eye is nearer to the picture's plane than the other."""
    middle = np.array(place)
    sight = middle / np.linalg.norm(middle)
    across = np.array([sight[2], 0.0, -sight[0]]) / np.hypot(sight[0], sight[2])
    axes = np.array([across, np.cross(sight, across)])
    eyes = middle + np.outer([IPD_M / 2, -IPD_M / 2], across)
    face = middle + np.random.default_rng(1).normal(0, 0.02, (468, 2)) @ axes
    for eye, corners in zip(eyes, CORNERS, strict=True):
        face[list(corners)] = eye + np.outer([0.012, -0.012], across)
    mesh_px = np.column_stack([seen(face), np.zeros(468)])  # the mesh has nothing of it along the line of sight
    pupils = Pupils(seen(eyes), 0.3, mesh_px, 12.0, "found", "", 1.0)
    rows, columns = np.mgrid[0:480, 0:640] + 0.5
    rays = np.stack([(columns - CAMERA.cx_px) / CAMERA.fx_px, (rows - CAMERA.cy_px) / CAMERA.fy_px], 2)
    depth_mm = np.rint(1000 * (sight @ middle) / (rays @ sight[:2] + sight[2])).astype(np.uint16)
    face_depth = FaceDepth(eye_distance_m=IPD_M)
    found = face_depth.at(pupils, depth_mm if has_depth else None, CAMERA, np.ones(2))
    assert np.abs(found.eyes_m - eyes[:, 2]).max() < 0.001
    assert face_depth.has_measured == has_depth


def seen(points_m: np.ndarray) -> np.ndarray:
    """(n, 2) pixels of points."""
    return points_m[:, :2] / points_m[:, 2:] * CAMERA.fx_px + [CAMERA.cx_px, CAMERA.cy_px]


@pytest.mark.parametrize("depth_mm", [0, 90, 9000], ids=["nothing", "too near", "the wall"])
def test_depth_that_fits_no_person_gives_no_eyes_and_a_reason(depth_mm: int) -> None:
    colour, depth, _ = scene(PLACE, intrinsics=CAMERA)
    finder = EyeFinder()
    assert finder.find(frame(colour, np.full_like(depth, depth_mm), CAMERA)) is None
    assert finder.reason == "the depth measured on the face does not match a person's size"


def test_without_depth_the_distance_is_as_good_as_eye_separations_are_alike() -> None:
    colour, _, (truth,) = scene(PLACE, intrinsics=CAMERA)
    learnt, known = EyeFinder(), EyeFinder(Settings.model_validate({"calibration": {"ipd_m": IPD_M}}))
    for number in range(20):
        eyes = [finder.find(frame(colour, None, CAMERA, number=number)) for finder in (learnt, known)]
    sigmas = [np.sqrt(found.covariance_m2[2, 2]) for found in eyes]
    errors = [abs(found.eyes_m[:, 2].mean() - PLACE[2]) for found in eyes]
    assert np.less(errors, 2.5 * np.array(sigmas)).all() and 0.01 < sigmas[0] < 0.05 and sigmas[1] < 0.02
    seen = eyes[0].eyes_m / eyes[0].eyes_m[:, 2:]
    np.testing.assert_allclose(seen, truth / truth[:, 2:], atol=0.003)  # no sideways error


def test_sigma_is_told_along_the_line_of_sight_and_across_it() -> None:
    place, line = np.array([0.3, 0.0, 0.4]), np.array([0.06, 0.0, 0.01])
    told = covariance(place, line, 0.001, 0.002, 0.004)
    sight, sideways = np.array([0.6, 0.0, 0.8]), np.array([0.8, 0.0, -0.6])
    for axis, sigma in ((sight, 0.004), (sideways, 0.001), (np.array([0.0, 1.0, 0.0]), 0.002)):
        assert np.sqrt(axis @ told @ axis) == pytest.approx(sigma)


def test_what_is_no_viewer_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    colour, depth, _ = scene(intrinsics=CAMERA)
    finder = EyeFinder()
    assert finder.find(frame(colour, depth, CAMERA)) is None and finder.reason == "no face"
    assert finder.find(SensorFrame(1, 1)) is None and "not deliver colour" in finder.reason
    colour, depth, _ = scene(np.array([0.0, 0.0, 2.5]), intrinsics=camera(), wall_m=6.0)
    monkeypatch.setattr("runtime.eyes.detect.RANGE_MAX_M", 2.0)
    assert finder.find(frame(colour, depth, camera())) is None and "the maximum is 2 m" in finder.reason


PLAIN_CAMERA = Intrinsics(640, 480, 400.0, 625.0, 320.0, 240.0)  # focal lengths of 500 pixels on average
LEFT_EYE, RIGHT_EYE = np.s_[225:255, 340:360], np.s_[225:255, 280:310]


def plain(*, apart_px: float = 60.0, deep_px: float = 0.0, relief_px: float = 0.0, iris_px: float = 12.0) -> Pupils:
    """A face in the picture's middle whose mesh points lie anywhere; the left eye is the deeper one."""
    random = np.random.default_rng(1)
    eyes = np.array([[320 + apart_px / 2, 240], [320 - apart_px / 2, 240]])
    mesh = np.column_stack([random.uniform([270, 200], [370, 300], (468, 2)), relief_px * random.uniform(-1, 1, 468)])
    for (x, y), corners, side in zip(eyes, CORNERS, (0.5, -0.5), strict=True):
        mesh[list(corners)] = [[x + 9, y, side * deep_px], [x - 9, y, side * deep_px]]
    return Pupils(eyes, 0.3, mesh, iris_px, "found", "", 1.0)


def wall(depth_mm: int = 500) -> U16:
    return np.full((480, 640), depth_mm, np.uint16)


def measured(
    depth_mm: U16 | None, *, pupils: Pupils | None = None, face: FaceDepth | None = None, scale: float = 1.0
) -> EyeDepths:
    return (face or FaceDepth()).at(pupils or plain(), depth_mm, PLAIN_CAMERA, np.full(2, scale))


def test_without_depth_the_distance_follows_from_irises_or_settings() -> None:
    learnt, known = FaceDepth(), FaceDepth(eye_distance_m=0.06)
    for iris_px in (12.0, 12.0, 6.0):  # the third is a mistake
        told = measured(None, pupils=plain(iris_px=iris_px), face=learnt)
        np.testing.assert_allclose([*told.eyes_m, told.sigma_m], [0.5087, 0.5087, 0.0228], atol=1e-4)
    for pupils, eyes_m in ((plain(), (0.5, 0.5)), (plain(apart_px=48, deep_px=36), (0.518, 0.482))):
        told = measured(None, pupils=pupils, face=known)
        np.testing.assert_allclose([*told.eyes_m, told.sigma_m], [*eyes_m, 0.00905], atol=1e-5)
    assert not learnt.has_measured and not known.has_measured


@pytest.mark.parametrize(("depth_mm", "is_a_person"), [(373, False), (377, True), (705, True), (711, False)])
def test_depth_must_fit_eyes_45_to_85_mm_apart(depth_mm: int, is_a_person: bool) -> None:
    face = FaceDepth()
    measured(wall(depth_mm), face=face)
    assert face.has_measured is is_a_person


@pytest.mark.parametrize(("count", "is_enough"), [(7, False), (8, True)])
def test_eight_points_with_depth_are_enough(count: int, is_enough: bool) -> None:
    depth, face = wall(0), FaceDepth()
    columns, rows = plain().mesh_px[RIGID][10 : 10 + count, :2].astype(int).T
    depth[rows, columns] = 500
    told = measured(depth, face=face)
    assert face.has_measured is is_enough
    assert told.eyes_m.mean() == pytest.approx(0.5 if is_enough else 0.525, abs=1e-4)  # else an adult's mean


@pytest.mark.parametrize(("left_mm", "right_mm", "eyes_m", "sigma_mm"), [
    (5, 5, (0.5045, 0.5045), 1.96), (15, 15, (0.5135, 0.5135), 1.96), (0, 15, (0.5, 0.5135), 1.96),
    (25, 25, (0.5, 0.5), 6.02), (-25, 5, (0.5, 0.5045), 4.48),
])  # fmt: skip
def test_nine_tenths_of_an_eye_s_own_depth_count_at_once(
    left_mm: int, right_mm: int, eyes_m: tuple[float, float], sigma_mm: float
) -> None:
    depth = wall()
    depth[LEFT_EYE], depth[RIGHT_EYE] = 500 + left_mm, 500 + right_mm
    for told in (measured(depth), measured(depth[::2, ::2], scale=0.5)):
        np.testing.assert_allclose([*told.eyes_m, told.sigma_m], [*eyes_m, sigma_mm / 1000], atol=2e-5)


@pytest.mark.parametrize("edge", [0, -1])
@pytest.mark.parametrize("axis", [0, 1])
def test_points_outside_the_depth_picture_have_no_depth(axis: int, edge: int) -> None:
    size, move_px = [480, 640], np.zeros(2)
    move_px[1 - axis] = -[230, 310][axis] if edge == 0 else 0
    size[axis] = 250 if axis == 0 else 330
    depth = np.full(size, 500, np.uint16)
    depth[np.s_[edge, :] if axis == 0 else np.s_[:, edge]] = 520
    face = plain()
    moved = Pupils(face.eyes_px + move_px, 0.3, face.mesh_px + np.array([*move_px, 0.0]), 12.0, "found", "", 1.0)
    camera = Intrinsics(640, 480, 500.0, 500.0, 320.0 + move_px[0], 240.0 + move_px[1])
    told = FaceDepth().at(moved, depth, camera, np.ones(2))
    np.testing.assert_allclose(told.eyes_m, 0.5, atol=1e-4)


@pytest.mark.parametrize(("ratio", "apart_mm"), [(0.0, 0.0), (0.5, 5.0), (1.0, 10.0), (1.3, 13.0), (1.6, 13.0)])
def test_eyes_are_as_deep_as_the_face_has_relief(ratio: float, apart_mm: float) -> None:
    """A printed face has none."""
    pupils, depth = plain(relief_px=20.0, deep_px=10.0), wall()
    for x, y, z in pupils.mesh_px[RIGID]:
        depth[int(y) - 1 : int(y) + 2, int(x) - 1 : int(x) + 2] = round(500 + ratio * z)
    for middle_mm, half_mm, off_mm in ((0, 0.0, 0.4), (500, apart_mm / 2, 1.3)):  # without the eyes' own depth or with
        depth[LEFT_EYE], depth[RIGHT_EYE] = round(middle_mm + half_mm), round(middle_mm - half_mm)
        told = measured(depth, pupils=pupils, face=FaceDepth(eye_distance_m=0.0608))
        assert (told.eyes_m[0] - told.eyes_m[1]) * 1000 == pytest.approx(apart_mm, abs=off_mm)


def test_sigma_has_the_depth_picture_s_noise_over_the_points() -> None:
    """A median's 1.25 deviations of 10 mm over the root of 51 points, 0.5 mm, and what is not known of the eyes."""
    random = np.random.default_rng(0)
    told_m = [measured(random.normal(500.5, 10.0, (480, 640)).astype(np.uint16)).sigma_m for _ in range(20)]
    assert np.mean(told_m) == pytest.approx(np.sqrt(1.75**2 + 0.5**2 + 1.9**2) / 1000, rel=0.05)


def test_a_measured_face_is_known_until_the_head_turns() -> None:
    face = FaceDepth()
    sigmas_m = [measured(wall(), face=face).sigma_m for _ in range(6)]
    assert sigmas_m == sorted(sigmas_m, reverse=True) and sigmas_m[-1] < 0.0009
    kept, turned, back = (
        measured(None, pupils=pupils, face=face) for pupils in (plain(), plain(apart_px=48, deep_px=36), plain())
    )
    np.testing.assert_allclose(np.stack([kept.eyes_m, turned.eyes_m]), 0.5, atol=1e-5)
    np.testing.assert_allclose([kept.sigma_m, turned.sigma_m, back.sigma_m], [0.00095, 0.0300, 0.0424], atol=1e-4)
