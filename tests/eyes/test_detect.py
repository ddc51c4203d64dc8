"""Two eyes out of colour and depth: a real face at known places, seen by a camera that has its faults."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from runtime.clock import NS_PER_S
from runtime.config import DetectorSettings, Settings
from runtime.errors import InputError
from runtime.eyes.detect import EyeFinder, make_finder
from runtime.eyes.faces import Face, choose_eyes
from runtime.records import SensorFrame
from tests.eyes.scene import camera, frame, scene

HD = camera()
SMALL = camera(640, 480, 60.0)
NEAR = np.array([0.05, 0.02, 0.6])


class Given:
    """A face finder that finds what the test says, at given places of the whole picture."""

    def __init__(self, *faces: Face) -> None:
        self.faces, self.calls = list(faces), 0

    def find(self, picture: NDArray[np.uint8], *, smallest_px: int, largest_px: int) -> list[Face]:
        self.calls += 1
        return list(self.faces)


def face_at(
    x: float,
    *,
    width: float = 80.0,
    eyes: tuple[tuple[float, float], tuple[float, float]] = ((52.0, 30.0), (24.0, 30.0)),
) -> Face:
    corner = np.array([x, 100.0])
    return Face(x, 100.0, width, width, np.array(eyes) * width / 80 + corner)


def depth_picture(depth_mm: int = 700, *, shape: tuple[int, int] = (480, 640)) -> NDArray[np.uint16]:
    return np.full(shape, depth_mm, np.uint16)


GREY = np.full((480, 640, 3), 90, np.uint8)


@pytest.mark.parametrize("place", [(0.0, 0.0, 0.4), (0.1, 0.05, 0.6), (-0.25, -0.1, 0.9), (0.3, 0.1, 1.4)])
def test_eyes_of_a_real_face_are_found_to_some_millimetres(place: tuple[float, float, float]) -> None:
    colour, depth, (truth,) = scene(np.array(place), intrinsics=HD)
    finder = EyeFinder()
    for number in (1, 2, 3):  # in the whole picture, then in a window
        found = finder.find(frame(colour, depth, HD, number=number))
        assert found is not None and found.completed == ""
        assert np.abs(found.eyes_m - truth).max() < 0.004
        assert (found.confidence >= 0.5).all()


def test_the_viewers_left_eye_comes_first() -> None:
    colour, depth, _ = scene(NEAR, intrinsics=SMALL)
    found = EyeFinder().find(frame(colour, depth, SMALL))
    assert found.eyes_m[0, 0] > found.eyes_m[1, 0]  # on the right of an unmirrored picture


def test_depth_of_another_size_is_registered_by_scale() -> None:
    colour, depth, (truth,) = scene(NEAR, intrinsics=HD, depth_size=(512, 288))
    found = EyeFinder().find(frame(colour, depth, HD))
    assert np.abs(found.eyes_m - truth).max() < 0.004


def test_noise_holes_and_the_wall_behind_do_not_pull_the_eyes() -> None:
    colour, depth, (truth,) = scene(NEAR, intrinsics=SMALL)
    random = np.random.default_rng(0)
    noisy = (depth + random.normal(0, 8, depth.shape)).astype(np.uint16)
    noisy[random.random(depth.shape) < 0.5] = 0
    noisy[random.random(depth.shape) < 0.1] = 4000
    found = EyeFinder().find(frame(colour, noisy, SMALL))
    assert np.abs(found.eyes_m[:, 2] - truth[:, 2]).max() < 0.006


def test_an_eye_without_depth_takes_that_of_the_face() -> None:
    colour, depth, (truth,) = scene(NEAR, intrinsics=SMALL)
    for eye in truth:  # glasses: 25 pixels around each eye measure nothing
        u, v = (eye[:2] / eye[2] * SMALL.fx_px + [SMALL.cx_px, SMALL.cy_px]).astype(int)
        depth[v - 12 : v + 12, u - 12 : u + 12] = 0
    found = EyeFinder().find(frame(colour, depth, SMALL))
    assert np.abs(found.eyes_m - truth).max() < 0.004


@pytest.mark.parametrize("depth_mm", [0, 90, 9000], ids=["all zero", "too near", "too far"])
def test_a_face_without_usable_depth_gives_no_eyes_and_says_so(depth_mm: int) -> None:
    colour, depth, _ = scene(NEAR, intrinsics=SMALL)
    finder = EyeFinder()
    assert finder.find(frame(colour, np.full_like(depth, depth_mm), SMALL)) is None
    assert finder.reason == "no depth on the face"


def test_an_empty_room_and_a_sensor_without_pictures_say_so() -> None:
    colour, depth, _ = scene(intrinsics=SMALL)
    finder = EyeFinder()
    assert finder.find(frame(colour, depth, SMALL)) is None and finder.reason == "no face"
    assert finder.find(SensorFrame(1, 1)) is None and "no registered colour" in finder.reason


def test_the_nearest_of_two_viewers_is_chosen_and_the_choice_is_stated() -> None:
    near, far = np.array([0.2, 0.0, 0.7]), np.array([-0.25, 0.0, 1.0])
    colour, depth, (_, truth) = scene(near, far, intrinsics=HD)
    finder = EyeFinder()
    found = finder.find(frame(colour, depth, HD))
    assert np.abs(found.eyes_m - truth).max() < 0.005
    assert finder.choice == "locked on the nearest of 2 face(s)"


def test_a_second_viewer_who_walks_in_nearer_does_not_take_the_lock() -> None:
    staying = np.array([-0.2, 0.0, 0.8])
    finder = EyeFinder()
    for number in range(1, 36):
        guest = np.array([0.45 - 0.01 * min(number, 25), 0.0, 0.6])
        colour, depth, _ = scene(staying, guest, intrinsics=SMALL)
        found = finder.find(frame(colour, depth, SMALL, number=number)) if number % 5 in (0, 1) else None
        if number == 1 and found is not None:
            # Both were there from the start in this picture: begin with the one who stays.
            colour, depth, _ = scene(staying, intrinsics=SMALL)
            finder = EyeFinder()
            found = finder.find(frame(colour, depth, SMALL, number=number))
        if found is not None:
            assert abs(found.eyes_m[:, 0].mean() - staying[0]) < 0.02
    assert finder.choice.startswith("lock")


def test_a_second_viewer_is_taken_over_before_the_picture_goes_flat() -> None:
    settings = Settings()
    first, second = face_at(100.0), face_at(400.0)
    given = Given(first)
    finder = EyeFinder(finder=given)
    assert finder.find(frame(GREY, depth_picture(), SMALL, number=1)) is not None
    given.faces = [second]
    first_ns = frame(GREY, depth_picture(), SMALL, number=1).capture_ns
    for number in range(2, 40):
        sample = frame(GREY, depth_picture(), SMALL, number=number)
        found = finder.find(sample)
        assert (found is not None) == (sample.capture_ns - first_ns > settings.detector.lock_s * NS_PER_S)
        if found is not None:
            assert sample.capture_ns - first_ns < settings.tracker.hold_s * NS_PER_S
            return
    raise AssertionError("never taken over")


@pytest.mark.parametrize("hidden", ["left", "right"])
def test_a_hidden_eye_is_filled_in_from_the_heads_pose_and_labelled(hidden: str) -> None:
    given = Given(face_at(200.0))
    finder = EyeFinder(finder=given)
    whole = finder.find(frame(GREY, depth_picture(), SMALL, number=30))
    eyes = given.faces[0].eyes_px.copy()
    eyes[0 if hidden == "left" else 1] = np.nan
    given.faces = [Face(200.0, 100.0, 80.0, 80.0, eyes)]
    # Number 60 looks at the whole picture, whose pixels the faces are given in.
    found = finder.find(frame(GREY, depth_picture(), SMALL, number=31))
    side = 0 if hidden == "left" else 1
    assert found.completed == hidden and found.confidence[side] < found.confidence[1 - side]
    np.testing.assert_allclose(found.eyes_m[1] - found.eyes_m[0], whole.eyes_m[1] - whole.eyes_m[0], atol=1e-9)


def test_a_hidden_eye_is_not_invented_without_a_recent_pose() -> None:
    one = Face(200.0, 100.0, 80.0, 80.0, np.array([[252.0, 130.0], [np.nan, np.nan]]))
    finder = EyeFinder(finder=Given(one))
    assert finder.find(frame(GREY, depth_picture(), SMALL)) is None
    assert "pose is not known" in finder.reason


def test_eyes_at_distances_of_two_faces_are_refused() -> None:
    depth = depth_picture()
    depth[:, 238:] = 790  # what lies under the left eye is nine centimetres behind
    finder = EyeFinder(finder=Given(face_at(200.0)))
    assert finder.find(frame(GREY, depth, SMALL)) is None
    assert "one face" in finder.reason


def test_a_viewer_walking_out_over_the_edge_is_lost_without_an_error() -> None:
    finder = EyeFinder()
    results = []
    for number in range(1, 30):
        colour, depth, _ = scene(np.array([0.02 * number, 0.0, 0.7]), intrinsics=SMALL)
        results.append(finder.find(frame(colour, depth, SMALL, number=number)) is not None)
    assert results[0] and not results[-1]


def test_a_candidate_pair_is_level_symmetric_and_as_wide_as_eyes_are() -> None:
    centres = np.array([[50.0, 60.0], [110.0, 62.0], [52.0, 100.0], [80.0, 90.0]])  # eyes, mouth corner, nose
    assert choose_eyes(centres, width=160.0).tolist() == [[110.0, 62.0], [50.0, 60.0]]
    assert np.isnan(choose_eyes(np.zeros((0, 2)), width=160.0)).all()
    left_only = choose_eyes(np.array([[112.0, 60.0]]), width=160.0)
    assert left_only[0].tolist() == [112.0, 60.0] and np.isnan(left_only[1]).all()


def test_yunet_wants_a_model_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="yunet_model"):
        make_finder(DetectorSettings(kind="yunet"))
    (tmp_path / "no.onnx").write_bytes(b"not a model")
    for name in ("no.onnx", "missing.onnx"):
        with pytest.raises(InputError, match=name):
            make_finder(DetectorSettings(kind="yunet", yunet_model=str(tmp_path / name)))


def test_following_a_face_in_full_hd_is_far_cheaper_than_one_search_of_the_full_picture() -> None:
    # 30 frames a second on one core: the figure itself is in docs/sensors.md, machines differ.
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    colour, depth, _ = scene(NEAR, intrinsics=HD)
    finder = EyeFinder()
    finder.find(frame(colour, depth, HD))

    def took(call: Any) -> Any:
        begin = time.process_time()
        call()
        return time.process_time() - begin

    followed = [took(lambda k=k: finder.find(frame(colour, depth, HD, number=k))) for k in range(2, 14)]
    cascades = make_finder(DetectorSettings())
    full = took(lambda: cascades.find(colour, smallest_px=60, largest_px=1080))
    cv2.setNumThreads(threads)
    assert np.median(followed) < full / 3
