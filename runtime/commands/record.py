"""`phasestack record`: record the sensor's samples in a file for `--replay` to play back."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from runtime.errors import FatalError, InputError
from runtime.support.options import ConfigOption, JsonOption, number
from runtime.support.ranges import RECORD_MOST_S

if TYPE_CHECKING:
    from runtime.config import Settings
    from runtime.records import SensorFrame
    from runtime.sensor.live import LiveSamples

POLL_S = 0.004  # polling interval, a quarter of the period at 60 Hz
FIRST_SAMPLE_S = 15.0  # how long to wait for the first sample
SUFFIX = ".mcap"
OVER = ("ended", "failed")


def record(
    out: Annotated[Path, typer.Option(help="recording to write (.mcap)")],
    config: ConfigOption = None,
    images: Annotated[bool, typer.Option("--images", help="also record pictures, which show people's faces")] = False,
    seconds: Annotated[float | None, number(0.1, RECORD_MOST_S, "s", help="length (default: 600; motions: 12)")] = None,
    motion: Annotated[
        str | None,
        typer.Option(
            help="record a simulated head instead of the sensor (still, lean, nod, walk or stop-and-go), or two "
            "(two-still, two-lean, two-one-leans, two-pass, two-exchange, two-leave or two-sit)"
        ),
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="random seed for the head's path (with --motion)")] = None,
    rate_hz: Annotated[float | None, number(15, 240, "Hz", help="samples per second (with --motion)")] = None,
    noise_mm: Annotated[float | None, number(0, 100, "mm", help="sensor noise on each axis (with --motion)")] = None,
    as_json: JsonOption = False,
) -> None:
    """Record eye positions, when they were seen and, with --images, pictures. Press Ctrl-C to stop.

    With --motion, a head is simulated as in the tracker's benchmark. The recording then includes noise, outliers,
    dropouts and the true eyes.

    Example: phasestack record --out lean.mcap --seconds 20

    Example: phasestack record --motion walk --seed 3 --rate-hz 60 --out walk.mcap
    """
    _refuse_target(out, motion=motion is not None)
    simulated = {"seed": seed, "rate_hz": rate_hz, "noise_mm": noise_mm}
    meaningless = {"config": config, "images": images or None} if motion is not None else simulated
    for name, value in meaningless.items():
        if value is not None:
            why = "cannot be combined with --motion" if motion is not None else "requires --motion"
            raise InputError("record", f"--{name.replace('_', '-')}", why)
    if motion is not None:
        from runtime.evaluation.motion_recording import write_motion

        options: dict[str, Any] = {**simulated, "seconds": seconds}
        written = write_motion(out, motion, **{name: value for name, value in options.items() if value is not None})
        summary = written | {"holds": ["eyes", "true eyes"], "stopped": "the motion ended"}
    else:
        from runtime.config import load_settings

        summary = record_to(out, load_settings(config), images=images, seconds=seconds)
    if as_json:
        typer.echo(json.dumps(summary))
    else:
        length = f"{summary['samples']} samples, {summary['seconds']:.1f} s"
        typer.echo(f"{out}: {length}, {', '.join(summary['holds'])} ({summary['stopped']})")


def _refuse_target(out: Path, *, motion: bool) -> None:
    """Raise InputError if a file name has the wrong suffix, or the file exists or cannot be written. The recording of a
    simulated motion may be overwritten, because the same motion can be reproduced from its seed.
    """
    from runtime.sensor.recording import Recording
    from runtime.support.untrusted_input import checked_path

    checked_path(out, source="record", field="--out")
    if out.suffix.lower() != SUFFIX:
        raise InputError(out, "--out", f"must end in {SUFFIX} because recordings are MCAP files")
    if os.path.isdir(out):  # noqa: PTH112 - Path.is_dir raises if a parent folder is not accessible
        raise InputError(out, "--out", "is a folder; pass the name of a file")
    if not os.path.lexists(out):
        folder = next(folder for folder in out.absolute().parents if os.path.lexists(folder))
        if not os.path.isdir(folder):  # noqa: PTH112
            raise InputError(out, "--out", f"cannot be written: {folder} is not a folder")
        if not os.access(folder, os.W_OK | os.X_OK, effective_ids=True):
            raise InputError(out, "--out", "cannot be written: Permission denied")
        return
    try:
        if motion and Recording(out).header.driver == "motion":
            return
    except InputError:  # not a recording
        pass
    raise InputError(out, "--out", "already exists; choose another name or delete the file")


def record_to(out: Path, settings: Settings, *, images: bool, seconds: float | None) -> dict[str, Any]:
    """Record until Ctrl-C, a limit (by default ten minutes), or the end of the source. Returns a summary.
    Raises FatalError if the sensor cannot be used or delivers nothing, and InputError for the file.
    """
    from functools import partial

    from runtime.clock import NS_PER_S, MonotonicClock
    from runtime.eyes.detect import EyeFinder
    from runtime.sensor.live import SensorProcess, SensorSetup
    from runtime.sensor.recording import MAX_S, recording_to
    from runtime.sensor.recording_format import RecordingHeader
    from runtime.sensor.registry import open_sensor
    from runtime.support import progress

    clock, s = MonotonicClock(), settings.sensor
    make_finder = partial(EyeFinder, settings, most_people=settings.sought_people)
    setup = SensorSetup(partial(open_sensor, s, clock), s, clock, make_finder, keep_images=images)
    worker = SensorProcess(setup)
    max_s, stopped = seconds or MAX_S, "reached the time limit"
    writer, first_ns, so_far_s = None, 0, 0.0
    holds: dict[str, None] = {}
    with ExitStack() as cleanup:
        cleanup.callback(progress.tell, "", 0)
        cleanup.callback(worker.close)
        worker.start()
        try:
            for frame in _samples(worker, max_s):
                if writer is None:
                    first_ns, has = frame.capture_ns, worker.capabilities
                    pictures = has if images else None
                    header = RecordingHeader(
                        driver=s.driver,
                        serial=worker.serial,
                        colour=pictures is not None and pictures.colour,
                        depth=pictures is not None and pictures.depth,
                    )
                    writer = cleanup.enter_context(recording_to(out, header, max_s=max_s))
                if not writer.write(frame):
                    if frame.capture_ns - first_ns <= max_s * NS_PER_S:
                        stopped = "reached the limit of 2 GiB"
                    break
                so_far_s = (frame.capture_ns - first_ns) / NS_PER_S
                holds |= dict.fromkeys(_streams(frame))
                progress.tell(f"recorded {writer.count} samples, seconds elapsed", round(so_far_s), round(max_s))
            else:
                if worker.state in OVER:
                    stopped = worker.reason
        except KeyboardInterrupt:
            if writer is None:
                raise
            stopped = "stopped by Ctrl-C"
        if writer is None:
            why = worker.reason or "no data arrived"
            raise worker.error or FatalError(f"the sensor {s.driver} delivered no samples ({worker.state}: {why})")
    summary = {"file": str(out), "samples": writer.count, "seconds": so_far_s, "stopped": stopped}
    return summary | {"holds": list(holds), "skipped": worker.stale_inputs}


def _streams(frame: SensorFrame) -> list[str]:
    """List the kinds of data contained in a sample, such as `eyes` or `depth`."""
    parts = {"eyes": frame.eyes, "true eyes": frame.true_eyes_m, "colour": frame.colour, "depth": frame.depth_mm}
    return [name for name, value in parts.items() if value is not None]


def _samples(worker: LiveSamples, limit_s: float) -> Iterator[SensorFrame]:
    """Yield samples until the source ends or until `limit_s` seconds after the first sample."""
    import time

    deadline_ns, begun = time.monotonic_ns() + round(FIRST_SAMPLE_S * 1e9), False
    while True:
        is_over = worker.state in OVER  # check before `take`, because the last samples arrive before this state
        frames = worker.take()
        if frames and not begun:
            deadline_ns, begun = frames[0].capture_ns + round(limit_s * 1e9), True
        yield from frames
        if not frames:
            if is_over or time.monotonic_ns() >= deadline_ns:
                return
            time.sleep(POLL_S)
