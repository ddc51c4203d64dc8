"""`phasestack record`: what the sensor sees, into a file that `--replay` plays."""

from __future__ import annotations

import json
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from runtime.support.options import number
from runtime.support.ranges import RECORD_MOST_S

if TYPE_CHECKING:
    from runtime.config import Settings
    from runtime.records import SensorFrame
    from runtime.sensor.recording_format import RecordingHeader
    from runtime.sensor.worker import SensorWorker

POLL_S = 0.004
FIRST_SAMPLE_S = 15.0
SUFFIX = ".mcap"


def record(
    out: Annotated[Path, typer.Option(help="recording to write, .mcap")],
    config: Annotated[Path | None, typer.Option(help="TOML file; see `phasestack config`")] = None,
    images: Annotated[bool, typer.Option("--images", help="colour and depth as well: shows faces")] = False,
    seconds: Annotated[
        float | None, number(0.1, RECORD_MOST_S, "s", help="stop after this long; else Ctrl-C, with --motion 12 s")
    ] = None,
    motion: Annotated[
        str | None, typer.Option(help="no sensor, but a head that moves: still, lean, nod, walk or stop-and-go")
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="with --motion: another seed, another path")] = None,
    rate_hz: Annotated[float | None, number(15, 240, "Hz", help="with --motion: samples a second")] = None,
    noise_mm: Annotated[
        float | None, number(0, 100, "mm", help="with --motion: the sensor's noise, standard deviation an axis")
    ] = None,
    force: Annotated[
        bool,
        typer.Option(
            "--force", help="replace a recording of the same name; one of --motion may always replace its like"
        ),
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="what was recorded as one JSON object on stdout")] = False,
) -> None:
    """Record eye positions with their times; pictures only with --images. Ctrl-C ends a recording properly.

    With --motion a head moves as the tracker's benchmark has it: noise, outliers, dropouts, and the true eyes.

    Example: phasestack record --out lean.mcap --seconds 20

    Example: phasestack record --motion walk --seed 3 --rate-hz 60 --out walk.mcap
    """
    refuse_target(out, force=force or motion is not None)
    if motion is not None and not force and not _is_motion(out):  # which is made again from its seed; a viewer is not
        refuse_target(out, force=False)
    made = {"--seed": seed, "--rate-hz": rate_hz, "--noise-mm": noise_mm}
    if motion is not None:
        _refuse_with("--motion", {"--config": config, "--images": images or None})
        summary = _record_motion(out, motion, seed=seed, rate_hz=rate_hz, noise_mm=noise_mm, seconds=seconds)
    else:
        from runtime.config import load_settings

        _refuse_with("a sensor", made)
        summary = record_to(out, load_settings(config), images=images, seconds=seconds, quiet=as_json)
    if as_json:
        typer.echo(json.dumps(summary))
    else:
        length = f"{summary['samples']} samples, {summary['seconds']:.1f} s"
        typer.echo(f"{out}: {length}, {_contents(summary)} ({summary['stopped']})")


def refuse_target(out: Path, *, force: bool, source: str = "record", field: str = "--out") -> None:
    """Raises InputError for a name that is not a recording's, or one that is taken."""
    from runtime.errors import InputError
    from runtime.support.foreign import checked_path

    checked_path(out, source=source, field=field)
    if out.suffix.lower() != SUFFIX:
        raise InputError(out, field, f"must end in {SUFFIX}: recordings are MCAP files")
    if out.is_dir():
        raise InputError(out, field, "is a folder")
    if (out.exists() or out.is_symlink()) and not force:
        raise InputError(out, "--out", "is there already: take another name, or --force to replace it")


def _is_motion(out: Path) -> bool:
    """Whether a recording there was made by --motion."""
    from runtime.errors import InputError
    from runtime.sensor.recording import Recording

    try:
        return Recording(out).header.driver == "motion"
    except InputError:
        return False


def _refuse_with(what: str, options: dict[str, Any]) -> None:
    """Raises InputError for options that mean nothing with what is recorded."""
    from runtime.errors import InputError

    for name, value in options.items():
        if value is not None:
            raise InputError("record", name, f"has no meaning with {what}")


def _record_motion(
    out: Path, motion: str, *, seed: int | None, rate_hz: float | None, noise_mm: float | None, seconds: float | None
) -> dict[str, Any]:
    from runtime.evaluation.motion_recording import write_motion

    how = {"seed": seed, "rate_hz": rate_hz, "noise_mm": noise_mm, "seconds": seconds}
    given: dict[str, Any] = {name: value for name, value in how.items() if value is not None}
    return write_motion(out, motion, **given) | {"holds": ["eyes", "true eyes"], "stopped": "the motion is done"}


def _contents(summary: dict[str, Any]) -> str:
    """What a recording holds, in words."""
    holds = summary["holds"]
    pictures = [name for name in ("colour", "depth") if name in holds]
    parts = ["eye positions"] if "eyes" in holds else ["no eye positions"]
    if "true eyes" in holds:
        parts.append("the true eyes")
    if pictures:
        parts.append(f"{' and '.join(pictures)} pictures of whoever was there")
    elif summary.get("images_asked"):
        parts.append("no pictures (this sensor delivers none)")
    return ", ".join(parts)


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
        lambda: DetectingDriver(
            open_sensor(s, clock, limits=settings.limits),
            lambda: EyeFinder(settings).find,
            keep_images=images,
        ),
        s,
        clock,
    )
    limits = RecordingLimits(min(seconds or s.record_max_s, s.record_max_s), round(s.record_max_mib * (1 << 20)))
    in_time = seconds is not None and seconds <= s.record_max_s
    time_is_up = "the time is up" if in_time else "the limit sensor.record_max_s is reached"
    count, first_ns, last_ns = 0, 0, 0
    holds: dict[str, None] = {}
    pending: deque[SensorFrame] = deque()
    with ExitStack() as cleanup:
        cleanup.callback(worker.stop)
        worker.start()
        try:
            frame = _first(worker, clock.now_ns(), pending, driver=s.driver)
            first_ns = last_ns = frame.capture_ns
            writer = cleanup.enter_context(recording_to(out, _header(frame, s.driver, worker, images), limits=limits))
            tell = cleanup.enter_context(_progress(quiet, seconds))
            deadline_ns = frame.capture_ns + round((seconds or s.record_max_s) * 1e9)
            while True:
                frame = frame if images else replace(frame, colour=None, depth_mm=None)
                if not writer.write(frame):
                    is_long = frame.capture_ns - first_ns > limits.max_s * 1e9
                    stopped = time_is_up if is_long else "the limit sensor.record_max_mib is reached"
                    break
                count, last_ns = writer.count, frame.capture_ns
                tell(count, (last_ns - first_ns) / 1e9)
                holds |= dict.fromkeys(_streams(frame))
                following = _next(worker, deadline_ns, pending)
                if following is None:
                    stopped = worker.reason if worker.state in ("ended", "failed") else time_is_up
                    break
                frame = following
        except KeyboardInterrupt:
            stopped = "stopped by hand"
            if count == 0:
                raise
    told = {"file": str(out), "samples": count, "seconds": (last_ns - first_ns) / 1e9, "stopped": stopped}
    return told | {"holds": list(holds), "images_asked": images, "skipped": worker.stale_inputs}


def _streams(frame: SensorFrame) -> list[str]:
    """What a sample holds."""
    parts = {"eyes": frame.eyes, "true eyes": frame.true_eyes_m, "colour": frame.colour, "depth": frame.depth_mm}
    return [name for name, value in parts.items() if value is not None]


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


def _first(worker: SensorWorker, now_ns: int, pending: deque[SensorFrame], *, driver: str) -> SensorFrame:
    """The first sample. Raises FatalError where the sensor gives none."""
    from runtime.errors import FatalError

    frame = _next(worker, now_ns + round(FIRST_SAMPLE_S * 1e9), pending)
    if frame is None:
        why = worker.reason or "nothing came"
        raise worker.error or FatalError(f"sensor {driver}: no sample ({worker.state}: {why})")
    return frame


def _next(worker: SensorWorker, deadline_ns: int, pending: deque[SensorFrame]) -> SensorFrame | None:
    """The next sample, or None at the deadline and where none will come. `pending`: those that arrived with it."""
    import time

    while not pending:
        is_over = worker.state in ("ended", "failed")  # asked first: its last samples come before it says so
        pending.extend(worker.take())
        if not pending:
            if is_over or time.monotonic_ns() >= deadline_ns:
                return None
            time.sleep(POLL_S)
    return pending.popleft()


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
