"""`calibrate capture`: viewpoints, where the sensor sees the eyes at them, and the file of pairs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calib.capture import MAX_SPREAD_M, WINDOW_S, midpoint, true_pair
from calib.hardware import SetupHardware, eye_finder
from calib.pairs import PairRow, PairsFile
from calib.viewpoints import grid
from calib.walk import Walk
from runtime.clock import NS_PER_S, SimulatedClock
from runtime.config import Settings
from runtime.errors import EndOfRecording, InputError
from runtime.records import F64, EyePoints, SensorFrame
from runtime.sensor.base import SteppedSensor
from runtime.sensor.registry import open_sensor


def capture_live(
    out: Path, settings: Settings, hardware: SetupHardware, *, show: bool, say: Callable[[str], None]
) -> dict[str, Any]:
    """Walk through the viewpoints with a person before the display. Raises InputError, FatalError."""
    file = PairsFile(out)
    say(f"sensor: {hardware.open_sensor(settings)}")
    chart = hardware.chart(settings) if show else None
    try:
        walk = Walk(file, grid(settings.calibration), say=say, chart=chart)
        walk.begin()
        while not walk.finished:
            while not walk.finished and (sample := hardware.sample(walk.current)) is not None:
                walk.see(sample.capture_ns, sample.eyes, serial=sample.serial)
            key = hardware.poll()
            if key is None:
                hardware.wait()
            walk.press(key)
        return walk.summary()
    finally:
        if chart is not None:
            chart.close()


def capture_recording(out: Path, settings: Settings, *, source: str) -> dict[str, Any]:
    """Pairs from a recording that knows its true eyes, half a second each. Raises InputError."""
    chosen = settings.sensor.model_copy(update={"driver": "replay", "source": source, "loop": False, "start_s": 0.0})
    driver = open_sensor(chosen, SimulatedClock())
    if not isinstance(driver, SteppedSensor):
        raise InputError(source, "", "cannot be replayed sample by sample")
    file = PairsFile(out)
    accepted, skipped = 0, []
    with driver:
        if driver.capabilities.in_stack_frame:
            raise InputError(source, "", "its eyes are in the stack's frame already: there is nothing to calibrate")
        find = eye_finder(driver, settings)
        frames = list(_all_samples(driver))
        if all(frame.true_eyes_m is None for frame in frames):
            raise InputError(source, "", "does not know where the eyes truly were: capture from the live sensor")
        for pair in _from_truth(frames, find, serial=driver.serial):
            if isinstance(pair, str):
                skipped.append(pair)
            else:
                file.accept(pair)
                accepted += 1
    if not len(file):
        raise InputError(source, "", "gives no pair: " + ("; ".join(skipped[:3]) or "no usable eyes"))
    return {"file": str(out), "pairs": len(file), "accepted": accepted, "skipped": skipped}


def _all_samples(driver: SteppedSensor) -> Iterator[SensorFrame]:
    while True:
        try:
            yield driver.next_sample()
        except EndOfRecording:
            return


def _from_truth(
    frames: Sequence[SensorFrame], find: Callable[[SensorFrame], EyePoints | None], *, serial: str
) -> Iterator[PairRow | str]:
    """A pair for each stretch of `WINDOW_S`, or why there is none."""
    first_ns = frames[0].capture_ns
    stretches: dict[int, list[tuple[float, F64, F64]]] = {}
    for frame in frames:
        middle = midpoint(find(frame))
        if middle is not None and frame.true_eyes_m is not None:
            seconds = (frame.capture_ns - first_ns) / NS_PER_S
            stretches.setdefault(int(seconds / WINDOW_S), []).append((seconds, middle, frame.true_eyes_m.mean(axis=0)))
    for number, samples in sorted(stretches.items()):
        times, sensor, true = (np.array(column) for column in zip(*samples, strict=True))
        found = true_pair(times, sensor, true)
        name = f"at {number * WINDOW_S:.2f} s"
        if found is None or found[0].spread_m > MAX_SPREAD_M:
            yield f"{name}: " + ("too few samples" if found is None else f"spread {found[0].spread_m * 1e3:.1f} mm")
            continue
        seen, true_m = found
        yield seen.paired(true_m, name, serial=serial)
