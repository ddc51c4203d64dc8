"""Makes the built-in recording: a viewer who leans, comes near, goes far, and looks from the side.

    python -m runtime.evaluation.demo_recording [FILE.mcap]

Seeded and deterministic to the byte.
"""

from __future__ import annotations

import io
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from runtime.clock import NS_PER_S
from runtime.eyes.demo_geometry import demo_sensor_from_stack
from runtime.eyes.motions import minimum_jerk
from runtime.optics.views import stack_from_eye
from runtime.records import F64, EyePoints, SensorFrame
from runtime.sensor.recording import RecordingWriter
from runtime.sensor.recording_format import RecordingHeader
from runtime.sensor.replay import demo_recording_path
from runtime.support.artifacts import write_bytes

RATE_HZ, SECONDS, SEED = 30, 10, 20240229
IPD_M, NOISE_M = 0.062, 0.0025
NO_FACE_S = ((2.0, 2.2), (5.0, 5.8))
BLINK_S, BLINK_CONFIDENCE, BLINK_NOISE = (7.5, 7.6), 0.2, 2.0
# Time s, distance m, azimuth deg (towards the viewer's right), height m, roll deg; at rest in each.
POSES = np.array(
    [
        [0.0, 0.60, 0.0, 0.03, 0.0],
        [1.2, 0.60, -12.0, 0.02, -5.0],
        [2.6, 0.58, 15.0, 0.04, 6.0],
        [3.8, 0.35, 4.0, 0.00, 0.0],
        [6.2, 1.20, -3.0, 0.10, 3.0],
        [8.6, 0.70, 65.0, 0.05, -4.0],
        [9.0, 0.70, 65.0, 0.05, -4.0],
        [10.0, 0.65, 48.0, 0.06, 2.0],
    ]
)


def true_eyes(time_s: float) -> F64:
    """(2, 3) left and right eye in `stack`, metres: the head faces the display, and tilts."""
    (pose_now,) = minimum_jerk(np.array([time_s]), knots_s=POSES[:, 0], values=POSES[:, 1:])
    distance, azimuth_deg, height, roll_deg = pose_now
    azimuth, roll = np.deg2rad(azimuth_deg), np.deg2rad(roll_deg)
    middle = np.array([distance * np.cos(azimuth), distance * np.sin(azimuth), height])
    pose = stack_from_eye(middle)
    towards_right = np.cos(roll) * pose[:3, 0] + np.sin(roll) * pose[:3, 1]
    return np.array([middle - IPD_M / 2 * towards_right, middle + IPD_M / 2 * towards_right])


def samples() -> Iterator[SensorFrame]:
    """The recording's samples."""
    random, sensor = np.random.default_rng(SEED), demo_sensor_from_stack()
    for k in range(RATE_HZ * SECONDS):
        time_s = k / RATE_HZ
        truth = true_eyes(time_s)
        blinks = BLINK_S[0] <= time_s < BLINK_S[1]
        noise = random.normal(0.0, NOISE_M * (BLINK_NOISE if blinks else 1.0), (2, 3))
        confidence = np.full(2, BLINK_CONFIDENCE if blinks else 0.95)
        lost = any(start <= time_s < end for start, end in NO_FACE_S)
        yield SensorFrame(
            sequence=k + 1,
            capture_ns=NS_PER_S + k * NS_PER_S // RATE_HZ,
            eyes=None if lost else EyePoints(truth @ sensor[:3, :3].T + sensor[:3, 3] + noise, confidence),
            true_eyes_m=truth,
        )


def demo_recording_bytes() -> bytes:
    """The whole file."""
    file = io.BytesIO()
    writer = RecordingWriter(file, RecordingHeader(driver="demo", serial="demo", truth=True))
    for frame in samples():
        writer.write(frame)
    writer.finish()
    return file.getvalue()


if __name__ == "__main__":
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else demo_recording_path()
    write_bytes(target, demo_recording_bytes())
    print(target)
