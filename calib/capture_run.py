"""`calibrate capture`: a sensor or a recording, the viewpoints, and the file of pairs."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import typer

from calib.capture import EyeWindow, midpoint, true_pair
from calib.chart_files import ChartDisplay, Drawer
from calib.keys import Key, TerminalKeys, first_of
from calib.pairs import CapturedPair, PairsFile
from calib.viewpoints import IPD_M, Viewpoint, grid
from calib.walk import Walk, accept, captured
from runtime.clock import NS_PER_MS, NS_PER_S, MonotonicClock, SimulatedClock
from runtime.config import Settings
from runtime.errors import EndOfRecording, InputError
from runtime.eyes.detect import EyeFinder
from runtime.optics.stack import PanelStack
from runtime.records import F64, EyePoints, SensorFrame
from runtime.sensor.base import SensorDriver, SteppedDriver
from runtime.sensor.registry import open_sensor
from runtime.sensor.worker import SensorWorker
from runtime.support import foreign
from runtime.support.ranges import RECORD_MOST_S

POLL_NS = 20 * NS_PER_MS
SHOW_AGAIN_NS = 100 * NS_PER_MS
CHART_MODEL = "best"
Find = Callable[[SensorFrame], EyePoints | None]


def capture_recording(
    out: Path, settings: Settings, *, source: str, marks: Path | None, window_s: float, max_spread_m: float
) -> dict[str, Any]:
    """Pairs from a recording: at marked instants, or from its own true eyes. Raises InputError."""
    chosen = settings.sensor.model_copy(update={"driver": "replay", "source": source, "loop": False, "start_s": 0.0})
    driver = open_sensor(chosen, SimulatedClock(), limits=settings.limits)
    if not isinstance(driver, SteppedDriver):
        raise InputError(source, "", "cannot be replayed sample by sample")
    file = PairsFile(out)
    accepted, skipped = 0, []
    with driver:
        _refuse_stack_frame(driver, source)
        find = eye_finder(driver, settings)
        frames = list(_all_samples(driver))
        pairs: Iterator[CapturedPair | str]
        if marks is not None:
            pairs = _marked(
                frames,
                find,
                read_marks(marks, grid(settings.calibration)),
                window_s=window_s,
                max_spread_m=max_spread_m,
            )
        elif any(frame.true_eyes_m is not None for frame in frames):
            pairs = _from_truth(frames, find, window_s=window_s, max_spread_m=max_spread_m)
        else:
            raise InputError(source, "--marks", "is needed: this recording does not know where the eyes truly were")
        for pair in pairs:
            if isinstance(pair, str):
                skipped.append(pair)
            else:
                file.accept(replace(pair, sensor_serial=driver.serial))
                accepted += 1
    if not len(file):
        raise InputError(source, "", "gives no pair: " + ("; ".join(skipped[:3]) or "no usable eyes"))
    return {"file": str(out), "pairs": len(file), "accepted": accepted, "skipped": skipped}


def _refuse_stack_frame(driver: SensorDriver, source: str) -> None:
    if driver.capabilities.in_stack_frame:
        raise InputError(source, "", "its eyes are in the stack's frame already: there is nothing to calibrate")


def eye_finder(driver: SensorDriver, settings: Settings) -> Find:
    """Eyes of a frame in frame `sensor`: the sensor's own, or found in its images."""
    if driver.capabilities.eye_points:
        return lambda frame: frame.eyes

    finder = EyeFinder(settings.detector)
    return lambda frame: frame.eyes if frame.eyes is not None else finder.find(frame)


def _all_samples(driver: SteppedDriver) -> Iterator[SensorFrame]:
    while True:
        try:
            yield driver.next_sample()
        except EndOfRecording:
            return


def read_marks(path: Path, viewpoints: Sequence[Viewpoint]) -> list[tuple[float, Viewpoint]]:
    """`seconds,viewpoint` rows: when each chart was accepted. Raises InputError, naming the row and the column."""
    known = {viewpoint.name: viewpoint for viewpoint in viewpoints}
    found = []
    try:
        with io.StringIO(foreign.read_text(path), newline="") as file:
            reader = csv.DictReader(file, skipinitialspace=True)
            if not {"seconds", "viewpoint"} <= set(reader.fieldnames or ()):
                raise InputError(path, "columns", "must be seconds, viewpoint")
            for row in reader:
                label = f"line {reader.line_num}"
                try:
                    seconds = float(row["seconds"] or "")
                except ValueError:
                    seconds = math.nan
                if not 0 <= seconds <= RECORD_MOST_S:
                    raise InputError(path, f"{label}, seconds", f"is not a time: {row['seconds']}")
                name = (row["viewpoint"] or "").strip()
                if name not in known:
                    raise InputError(path, f"{label}, viewpoint", f"unknown: {name}")
                found.append((seconds, known[name]))
    except csv.Error as error:
        raise InputError(path, "", f"malformed: {error}") from None
    if not found:
        raise InputError(path, "", "holds no mark")
    return found


def _marked(
    frames: Sequence[SensorFrame],
    find: Find,
    marks: Sequence[tuple[float, Viewpoint]],
    *,
    window_s: float,
    max_spread_m: float,
) -> Iterator[CapturedPair | str]:
    for seconds, viewpoint in marks:
        window = EyeWindow(window_s)
        until_ns = frames[0].capture_ns + round(seconds * NS_PER_S)
        since_ns = until_ns - round(window_s * NS_PER_S)
        for frame in frames:
            if since_ns <= frame.capture_ns <= until_ns:
                window.add(frame.capture_ns, find(frame))
        result = accept(window.measure(), viewpoint, max_spread_m=max_spread_m)
        yield f"{viewpoint.name}: {result}" if isinstance(result, str) else result


def _from_truth(
    frames: Sequence[SensorFrame], find: Find, *, window_s: float, max_spread_m: float
) -> Iterator[CapturedPair | str]:
    first_ns = frames[0].capture_ns
    stretches: dict[int, list[tuple[float, F64, F64]]] = {}
    for frame in frames:
        middle = midpoint(find(frame))
        if middle is not None and frame.true_eyes_m is not None:
            seconds = (frame.capture_ns - first_ns) / NS_PER_S
            stretches.setdefault(int(seconds / window_s), []).append((seconds, middle, frame.true_eyes_m.mean(axis=0)))
    for number, samples in sorted(stretches.items()):
        times, sensor, true = (np.array(column) for column in zip(*samples, strict=True))
        pair = true_pair(times, sensor, true)
        name = f"at {number * window_s:.2f} s"
        if pair is None or pair.measured.spread_m > max_spread_m:
            yield f"{name}: " + ("too few samples" if pair is None else f"spread {pair.measured.spread_m * 1e3:.1f} mm")
            continue
        yield captured(pair.measured, pair.true_m, name)


def capture_live(
    out: Path,
    settings: Settings,
    viewpoints: Sequence[Viewpoint],
    *,
    stack: PanelStack,
    show: bool,
    again: bool,
    window_s: float,
    max_spread_m: float,
    hold_s: float,
) -> dict[str, Any]:
    """Walk through the viewpoints with a person before the display. Raises InputError, FatalError."""
    clock = MonotonicClock()
    file = PairsFile(out)
    open_sensor(settings.sensor, clock)  # refuses unknown names before anything starts
    worker = SensorWorker(lambda: open_sensor(settings.sensor, clock, limits=settings.limits), settings.sensor, clock)
    chart = _chart_display(settings, stack) if show else None
    keys = TerminalKeys()
    poll = keys.poll if chart is None else first_of(keys.poll, chart.keys.poll)
    worker.start()
    try:
        walk = Walk(
            file, viewpoints, again=again, window_s=window_s, max_spread_m=max_spread_m, say=_say, chart=chart,
            hold_s=hold_s,
        )  # fmt: skip
        told = ""
        while worker.capabilities is None:
            if worker.error is not None:
                raise worker.error
            if worker.reason and worker.reason != told:
                told = worker.reason
                _say(f"waiting for the sensor: {told} (q: stop)")
            if poll() is Key.QUIT:
                return walk.summary()
            clock.sleep_until_ns(clock.now_ns() + POLL_NS)
        find = _finder_of(worker, settings)
        walk.begin()
        shown_ns = clock.now_ns()
        while not walk.finished:
            if worker.error is not None:
                raise worker.error
            frame = worker.newest()
            if frame is not None:
                walk.see(frame.capture_ns, find(frame), serial=worker.serial)
            if chart is not None and clock.now_ns() - shown_ns > SHOW_AGAIN_NS:
                chart.again()
                shown_ns = clock.now_ns()
            walk.press(poll())
            clock.sleep_until_ns(clock.now_ns() + POLL_NS)
        return walk.summary()
    finally:
        keys.close()
        worker.stop()
        if chart is not None:
            chart.close()


def _finder_of(worker: Any, settings: Settings) -> Find:
    if worker.capabilities.in_stack_frame:
        raise InputError("sensor", "driver", "its eyes are in the stack's frame already: there is nothing to calibrate")
    return eye_finder(worker, settings)


def _chart_display(settings: Settings, stack: PanelStack) -> Any:
    ipd_m = settings.calibration.ipd_m or IPD_M
    drawer = Drawer(stack, kind="solved", ipd_m=ipd_m, model=CHART_MODEL, settings=settings.model)
    return ChartDisplay(settings, drawer)


def _say(text: str) -> None:
    typer.echo(text, err=True)
