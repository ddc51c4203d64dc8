"""`phasestack record`: what the sensor sees, into a file that `--replay` plays."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from runtime.config import Settings
    from runtime.records import SensorFrame
    from runtime.sensor.recording_format import RecordingHeader
    from runtime.sensor.worker import SensorWorker

POLL_S = 0.004
FIRST_SAMPLE_S = 15.0


def record(
    out: Annotated[Path, typer.Option(help="recording to write, .mcap")],
    config: Annotated[Path | None, typer.Option(help="TOML file; see `phasestack config`")] = None,
    images: Annotated[bool, typer.Option("--images", help="colour and depth as well: shows faces")] = False,
    seconds: Annotated[float | None, typer.Option(min=0.1, help="stop after this long; else Ctrl-C")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="what was recorded as one JSON object on stdout")] = False,
) -> None:
    """Record eye positions with their times; pictures only with --images. Ctrl-C ends a recording properly.

    Example: phasestack record --out lean.mcap --seconds 20
    """
    from runtime.config import load_settings

    summary = record_to(out, load_settings(config), images=images, seconds=seconds, quiet=as_json)
    if as_json:
        typer.echo(json.dumps(summary))
    else:
        kind = "with pictures of whoever was there" if images else "eye positions only"
        typer.echo(f"{out}: {summary['samples']} samples, {summary['seconds']:.1f} s, {kind} ({summary['stopped']})")


def record_to(out: Path, settings: Settings, *, images: bool, seconds: float | None, quiet: bool) -> dict[str, Any]:
    """Record until the time is up, a limit is reached, the source ends or Ctrl-C. Raises FatalError, InputError."""
    from contextlib import ExitStack
    from dataclasses import replace

    from runtime.clock import MonotonicClock
    from runtime.eyes.detect import EyeFinder
    from runtime.sensor.detecting import DetectingDriver
    from runtime.sensor.recording import RecordingLimits, recording_to
    from runtime.sensor.registry import open_sensor
    from runtime.sensor.worker import SensorWorker

    clock, s = MonotonicClock(), settings.sensor
    worker = SensorWorker(
        lambda: DetectingDriver(open_sensor(s, clock), lambda: EyeFinder(settings.detector).find, keep_images=images),
        s,
        clock,
    )
    limits = RecordingLimits(min(seconds or s.record_max_s, s.record_max_s), round(s.record_max_mib * (1 << 20)))
    in_time = seconds is not None and seconds <= s.record_max_s
    time_is_up = "the time is up" if in_time else "the limit sensor.record_max_s is reached"
    count, first_ns, last_ns = 0, 0, 0
    with ExitStack() as cleanup:
        cleanup.callback(worker.stop)
        worker.start()
        try:
            frame = _first(worker, clock.now_ns())
            first_ns = last_ns = frame.capture_ns
            writer = cleanup.enter_context(recording_to(out, _header(frame, s.driver, worker, images), limits=limits))
            tell = cleanup.enter_context(_progress(quiet, seconds))
            deadline_ns = frame.capture_ns + round((seconds or s.record_max_s) * 1e9)
            while True:
                if not writer.write(frame if images else replace(frame, colour=None, depth_mm=None)):
                    is_long = frame.capture_ns - first_ns > limits.max_s * 1e9
                    stopped = time_is_up if is_long else "the limit sensor.record_max_mib is reached"
                    break
                count, last_ns = writer.count, frame.capture_ns
                tell(count, (last_ns - first_ns) / 1e9)
                following = _next(worker, deadline_ns)
                if following is None:
                    stopped = worker.reason if worker.state in ("ended", "failed") else time_is_up
                    break
                frame = following
        except KeyboardInterrupt:
            stopped = "stopped by hand"
            if count == 0:
                raise
    return {"file": str(out), "samples": count, "seconds": (last_ns - first_ns) / 1e9, "stopped": stopped}


def _header(frame: SensorFrame, driver: str, worker: SensorWorker, images: bool) -> RecordingHeader:
    from runtime.sensor.recording_format import RecordingHeader

    has = worker.capabilities
    return RecordingHeader(
        driver=driver,
        serial=worker.serial,
        colour=images and has is not None and has.colour,
        depth=images and has is not None and has.depth,
        truth=frame.true_eyes_m is not None,
    )


def _first(worker: SensorWorker, now_ns: int) -> SensorFrame:
    """The first sample. Raises FatalError where the sensor gives none."""
    from runtime.errors import FatalError

    frame = _next(worker, now_ns + round(FIRST_SAMPLE_S * 1e9))
    if frame is None:
        raise worker.error or FatalError(f"sensor: no sample ({worker.state}: {worker.reason or 'nothing came'})")
    return frame


def _next(worker: SensorWorker, deadline_ns: int) -> SensorFrame | None:
    """The next sample, or None at the deadline and where none will come."""
    import time

    while time.monotonic_ns() < deadline_ns:
        frame = worker.newest()
        if frame is not None:
            return frame
        if worker.state in ("ended", "failed"):
            return worker.newest()
        time.sleep(POLL_S)
    return None


def _progress(quiet: bool, seconds: float | None) -> Any:
    """A context manager whose value takes the count of samples and the seconds so far."""
    from contextlib import contextmanager

    @contextmanager
    def shown() -> Any:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn

        columns = (TextColumn("recording"), BarColumn(), TextColumn("{task.fields[note]}"))
        with Progress(*columns, console=Console(stderr=True), disable=quiet, transient=True) as progress:
            task = progress.add_task("recording", total=seconds, note="")
            yield lambda count, so_far: progress.update(task, completed=so_far, note=f"{count} samples, {so_far:.1f} s")

    return shown()
