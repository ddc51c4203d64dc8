"""The built-in recording shows what it should."""

from __future__ import annotations

import numpy as np

from runtime.sensor.recording import Recording
from runtime.sensor.replay import demo_recording_path

FRAMES = list(Recording(demo_recording_path()).samples())
TRUTH = np.array([f.true_eyes_m for f in FRAMES])


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
