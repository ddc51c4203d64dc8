"""Writes one of the benchmark's motions as a recording, to run it through the whole pipeline.

    python -m runtime.commands.motion_recording walk walk.mcap
    phasestack run --replay walk.mcap --headless --max-speed --out out/walk

Noise, outliers and dropouts are the benchmark's; the truth is in the file, so the run's summary tells the displayed
quality at the true eyes. The sensor stands where the demo's calibration, the default, says.
"""

from __future__ import annotations

import sys
from pathlib import Path


def write_motion(path: Path, motion: str, *, seconds: float = 12.0, rate_hz: float = 30.0) -> None:
    """Raises InputError for a motion that is not known, or a file that can't be written."""
    import numpy as np

    from runtime.clock import NS_PER_S
    from runtime.errors import InputError
    from runtime.eyes.demo_geometry import demo_sensor_from_stack
    from runtime.eyes.motions import MOTIONS, observe, true_eyes
    from runtime.records import EyePoints, SensorFrame
    from runtime.sensor.recording import recording_to
    from runtime.sensor.recording_format import RecordingHeader

    if motion not in MOTIONS:
        raise InputError("motion", "", f"unknown: {motion!r}; known: {', '.join(MOTIONS)}")
    sensor_from_stack = demo_sensor_from_stack()
    observed = observe(motion, seconds=seconds, rate_hz=rate_hz)
    truth = true_eyes(motion, np.array([o.capture_ns for o in observed]) / NS_PER_S)
    with recording_to(path, RecordingHeader(driver="motion", serial="demo", truth=True)) as writer:
        for number, (seen, eyes) in enumerate(zip(observed, truth, strict=True), start=1):
            points = None
            if seen.points is not None:
                place = seen.points.eyes_m @ sensor_from_stack[:3, :3].T + sensor_from_stack[:3, 3]
                points = EyePoints(place, seen.points.confidence)
            writer.write(SensorFrame(number, seen.capture_ns, points, true_eyes_m=eyes))


if __name__ == "__main__":
    write_motion(Path(sys.argv[2]), sys.argv[1])
