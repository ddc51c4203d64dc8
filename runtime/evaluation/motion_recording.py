"""Write recordings of benchmark motions, including the true eyes, for `phasestack record --motion`.

When a run replays such a recording, its summary can state the quality at the true eyes. The simulated sensor's pose
matches the demo calibration, which runs use by default.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from runtime.clock import NS_PER_S
from runtime.errors import InputError
from runtime.eyes.calibration import demo_sensor_from_stack
from runtime.eyes.motions import MOTIONS, observe, path_of, true_eyes
from runtime.eyes.two_people import MOTIONS_OF_TWO, observe_two
from runtime.records import EyePoints, SensorFrame
from runtime.sensor.recording import recording_to
from runtime.sensor.recording_format import RecordingHeader

SECONDS, RATE_HZ, NOISE_MM = 12.0, 30.0, 3.0
SECONDS_MAX = 3600.0  # maximum length of a recording; recordings are built in memory


def write_motion(
    path: Path,
    motion: str,
    *,
    seed: int = 0,
    seconds: float = SECONDS,
    rate_hz: float = RATE_HZ,
    noise_mm: float = NOISE_MM,
) -> dict[str, Any]:
    """Write a recording of a motion, and return a description of it. Seed 0 selects the benchmark's path
    and noise. Raises InputError if the motion is unknown, the length is out of range, or the file cannot be written.
    """
    if motion not in (*MOTIONS, *MOTIONS_OF_TWO):
        known = ", ".join((*MOTIONS, *MOTIONS_OF_TWO))
        raise InputError("record", "--motion", f"unknown motion {motion!r}; use one of {known}")
    if not 2 / rate_hz <= seconds <= SECONDS_MAX:
        raise InputError("record", "--seconds", f"must be from {2 / rate_hz:g} to {SECONDS_MAX:g}, not {seconds:g}")
    how = {"seconds": seconds, "rate_hz": rate_hz, "noise_m": noise_mm / 1000}
    frames = _of_two(motion, seed=seed, **how) if motion in MOTIONS_OF_TWO else _of_one(motion, seed=seed, **how)
    sensor_from_stack = demo_sensor_from_stack()

    def placed(points: EyePoints) -> EyePoints:
        return EyePoints(points.eyes_m @ sensor_from_stack[:3, :3].T + sensor_from_stack[:3, 3], points.confidence)

    header = RecordingHeader(driver="motion", serial="demo")
    with recording_to(path, header, max_s=2 * SECONDS_MAX) as writer:
        for frame in frames:
            eyes = None if frame.eyes is None else placed(frame.eyes)
            if not writer.write(replace(frame, eyes=eyes, others=tuple(map(placed, frame.others)))):
                raise InputError(path, "", "the recording would exceed the size limit; use a lower value")
    description = {"motion": motion, "seed": seed, "rate_hz": rate_hz, "noise_mm": noise_mm}
    return description | {"file": str(path), "samples": len(frames), "seconds": (len(frames) - 1) / rate_hz}


def _of_one(motion: str, *, seed: int, **how: float) -> list[SensorFrame]:
    way = path_of(seed)
    observed = observe(motion, **how, seed=1 + seed, path=way)
    truth = true_eyes(motion, np.array([o.capture_ns for o in observed]) / NS_PER_S, path=way)
    seen = enumerate(zip(observed, truth, strict=True), start=1)
    return [SensorFrame(number, each.capture_ns, each.points, true_eyes_m=true_m) for number, (each, true_m) in seen]


def _of_two(motion: str, *, seed: int, **how: float) -> list[SensorFrame]:
    return observe_two(motion, **how, seed=1 + seed)
