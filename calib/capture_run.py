"""`calibrate capture`: viewpoints, where the sensor sees the eyes at them, and the file of pairs."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

from calib.hardware import SetupHardware
from calib.pairs import PairRow, PairsFile
from calib.viewpoints import grid
from calib.walk import Walk, midpoint
from runtime.clock import NS_PER_S, SimulatedClock
from runtime.config import Settings
from runtime.errors import InputError
from runtime.sensor.registry import open_sensor
from runtime.sensor.samples import RecordedSamples


def capture_live(
    out: Path, settings: Settings, hardware: SetupHardware, *, show: bool, say: Callable[[str], None]
) -> dict[str, Any]:
    """Walk through the viewpoints with a person before the display. Raises InputError, FatalError."""
    file = PairsFile(out)
    say(f"sensor: {hardware.open_sensor(settings)}")
    try:
        chart = hardware.chart(settings) if show else None
        walk = Walk(file, grid(settings.calibration), say=say, chart=chart)
        walk.begin()
        while not walk.finished:
            while not walk.finished and (sample := hardware.sample(walk.current)) is not None:
                walk.see(*sample)
            key = hardware.poll()
            if key is None:
                hardware.wait()
            walk.press(key)
        return walk.summary()
    finally:
        hardware.let_go()


def capture_recording(out: Path, settings: Settings, *, source: str) -> dict[str, Any]:
    """A pair for every sample of a recording that knows its true eyes. Raises InputError."""
    chosen = settings.sensor.model_copy(update={"driver": "replay", "source": source, "loop": False})
    samples = RecordedSamples(open_sensor(chosen, SimulatedClock()))
    file, pairs, known = PairsFile(out), [], False
    with closing(samples):
        for frame in samples.arrived(sys.maxsize):
            if frame.true_eyes_m is None:
                continue
            known = True
            middle = midpoint(frame.eyes)
            if middle is not None:
                name = f"at {frame.capture_ns / NS_PER_S:.3f} s"
                pairs.append(PairRow.of(middle, frame.true_eyes_m.mean(axis=0), name, serial=samples.serial))
    if not pairs:
        why = "gives no pair: no usable eyes" if known else "does not know where the eyes truly were"
        raise InputError(source, "", f"{why}: capture from the live sensor")
    file.accept(*pairs)
    return {"file": str(out), "pairs": len(file), "accepted": len(pairs)}
