"""A benchmark's motion as a recording: what the pipeline replays is what the benchmark's tracker sees."""

import numpy as np
import pytest

from runtime.commands.motion_recording import write_motion
from runtime.errors import InputError
from runtime.eyes.demo_geometry import demo_stack_from_sensor
from runtime.eyes.motions import observe, true_eyes
from runtime.sensor.recording import Recording


def test_samples_are_the_observations_through_the_demos_calibration(tmp_path):
    write_motion(tmp_path / "walk.mcap", "walk", seconds=5.0)
    frames = list(Recording(tmp_path / "walk.mcap").samples())
    pose = demo_stack_from_sensor()
    for frame, seen in zip(frames, observe("walk", seconds=5.0, rate_hz=30.0), strict=True):
        assert frame.capture_ns == seen.capture_ns and (frame.eyes is None) == (seen.points is None)
        if frame.eyes is not None:
            place = frame.eyes.eyes_m @ pose[:3, :3].T + pose[:3, 3]
            np.testing.assert_allclose(place, seen.points.eyes_m, atol=1e-6)
    truth = true_eyes("walk", np.array([f.capture_ns for f in frames]) / 1e9)
    np.testing.assert_allclose([f.true_eyes_m for f in frames], truth, atol=1e-6)


def test_an_unknown_motion_is_refused_and_the_known_ones_are_listed(tmp_path):
    with pytest.raises(InputError, match="lean"):
        write_motion(tmp_path / "a.mcap", "moonwalk")
