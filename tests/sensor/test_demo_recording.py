"""The built-in recording is what its generator makes, and shows what it should."""

from __future__ import annotations

import numpy as np

from runtime.eyes.demo_geometry import demo_sensor_from_stack, demo_stack_from_sensor
from runtime.sensor.demo_recording import demo_recording_bytes, samples, sensor_from_stack
from runtime.sensor.recording import Recording
from runtime.sensor.replay import demo_recording_path

FRAMES = list(samples())
TRUTH = np.array([f.true_eyes_m for f in FRAMES])


def test_the_shipped_file_is_the_generators_to_the_byte() -> None:
    shipped = demo_recording_path().read_bytes()
    assert shipped == demo_recording_bytes() and len(shipped) < 200_000


def test_it_lasts_ten_seconds_at_30_hz_and_knows_the_truth() -> None:
    recording = Recording(demo_recording_path())
    frames = list(recording.samples())
    assert len(frames) == 300 and recording.header.truth and recording.is_whole
    assert np.ptp(np.diff([f.capture_ns for f in frames])) <= 1
    assert all(f.true_eyes_m is not None for f in frames)


def test_the_viewer_leans_comes_near_goes_far_and_looks_from_the_side() -> None:
    middle = TRUTH.mean(1)
    distance = np.linalg.norm(middle, axis=1)
    angle = np.degrees(np.arctan2(middle[:, 1], middle[:, 0]))
    roll = np.degrees(np.arcsin((TRUTH[:, 1] - TRUTH[:, 0])[:, 2] / 0.062))
    assert distance.min() < 0.36 and distance.max() > 1.19
    assert angle.min() < -11 and 64 < angle.max() < 66
    assert roll.min() < -3 and roll.max() > 5


def test_the_eyes_are_62_mm_apart_and_in_front_of_the_display() -> None:
    np.testing.assert_allclose(np.linalg.norm(TRUTH[:, 1] - TRUTH[:, 0], axis=1), 0.062, atol=1e-12)
    assert (TRUTH[:, :, 0] > 0.2).all()


def test_the_viewers_left_is_at_the_left_of_the_stack_and_on_the_right_of_the_sensors_picture() -> None:
    assert (TRUTH[:, 0, 1] < TRUTH[:, 1, 1]).all()
    seen = np.array([f.eyes.eyes_m for f in FRAMES if f.eyes is not None])
    assert (seen[:100, 0, 0] > seen[:100, 1, 0]).all() and (seen[:, :, 2] > 0).all()


def test_there_are_two_dropouts_and_a_blink() -> None:
    missing = np.array([f.eyes is None for f in FRAMES])
    starts = np.flatnonzero(np.diff(missing.astype(int)) == 1)
    ends = np.flatnonzero(np.diff(missing.astype(int)) == -1)
    assert (ends - starts).tolist() == [6, 24]
    unsure = [f.sequence for f in FRAMES if f.eyes is not None and f.eyes.confidence.max() < 0.3]
    assert len(unsure) == 3 and np.ptp(unsure) == 2


def test_the_noise_is_that_of_a_depth_camera() -> None:
    errors = np.concatenate(
        [
            (f.eyes.eyes_m - sensor_from_stack(f.true_eyes_m)).ravel()
            for f in FRAMES
            if f.eyes is not None and f.eyes.confidence.max() > 0.5
        ]
    )
    assert 0.0023 < errors.std() < 0.0027


def test_generator_and_demo_geometry_put_the_sensor_at_the_same_place() -> None:
    points = np.random.default_rng(0).normal(size=(20, 3))
    forward, back = demo_stack_from_sensor(), demo_sensor_from_stack()
    np.testing.assert_allclose(sensor_from_stack(points) @ forward[:3, :3].T + forward[:3, 3], points, atol=1e-12)
    np.testing.assert_allclose(forward @ back, np.eye(4), atol=1e-12)
    assert np.linalg.det(forward[:3, :3]) > 0.999999
