"""Recordings for golden runs, kept in `data` and made by `python -m tests.golden --record`.

They are stored, so that a change of a random generator never moves a reference.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from runtime.clock import NS_PER_S
from runtime.evaluation.motion_recording import write_motion
from runtime.eyes.calibration import demo_sensor_from_stack
from runtime.eyes.motions import observe, path_of, true_eyes
from runtime.eyes.two_people import MOTIONS_OF_TWO
from runtime.records import EyePoints, SensorFrame
from runtime.sensor.recording import recording_to
from runtime.sensor.recording_format import RecordingHeader

DATA = Path(__file__).parent / "data"


@dataclass(frozen=True, slots=True)
class Head:
    """A head that moves before a sensor with noise and outliers, and what of it is not recorded."""

    motion: str
    seconds: float
    rate_hz: float = 30.0
    seed: int = 0
    noise_mm: float = 2.0
    outliers: float = 0.05
    unseen_s: tuple[float, float] = (0.0, 0.0)  # the sensor delivers, but no face
    silent_s: tuple[float, float] = (0.0, 0.0)  # the sensor delivers nothing


HEADS = {
    "still": Head("still", 2.0, seed=1, noise_mm=1.0, outliers=0.0),
    "walk": Head("walk", 1.5, rate_hz=60.0, seed=3),
    "loss-and-return": Head("lean", 2.6, seed=5, unseen_s=(0.5, 0.62), silent_s=(0.8, 2.0)),
    "nod": Head("nod", 2.0, seed=2),
    "lean": Head("lean", 1.4, rate_hz=60.0, seed=8),
    "two": Head("two-one-leans", 1.2, seed=4),
}


def path_to(name: str) -> Path:
    """Path of a stored recording."""
    return DATA / f"{name}.mcap"


def write(name: str, path: Path) -> None:
    """Write one of HEADS: the same samples from the same generator."""
    head = HEADS[name]
    if head.motion in MOTIONS_OF_TWO:
        write_motion(path, head.motion, seed=head.seed, seconds=head.seconds, noise_mm=head.noise_mm)
        return
    way = path_of(head.seed)
    observed = observe(
        head.motion,
        seconds=head.seconds,
        rate_hz=head.rate_hz,
        noise_m=head.noise_mm / 1000,
        outliers=head.outliers,
        dropout_every_s=0.0,
        seed=1 + head.seed,
        path=way,
    )
    truth = true_eyes(head.motion, np.array([o.capture_ns for o in observed]) / NS_PER_S, path=way)
    sensor_from_stack = demo_sensor_from_stack()
    with recording_to(path, RecordingHeader(driver="golden", serial="demo")) as writer:
        for number, (seen, eyes_m) in enumerate(zip(observed, truth, strict=True), start=1):
            time_s, points = seen.capture_ns / NS_PER_S, None
            if head.silent_s[0] <= time_s < head.silent_s[1]:
                continue
            if seen.points is not None and not head.unseen_s[0] <= time_s < head.unseen_s[1]:
                place = seen.points.eyes_m @ sensor_from_stack[:3, :3].T + sensor_from_stack[:3, 3]
                points = EyePoints(place, seen.points.confidence)
            assert writer.write(SensorFrame(number, NS_PER_S + seen.capture_ns, points, true_eyes_m=eyes_m))
