"""`phasestack run`: the daemon, or a recording through the same code."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import Annotated

import typer

from runtime.support.options import number, told_by_option
from runtime.support.ranges import BUDGET_MOST_MS


def leave_at_once() -> None:
    """End the process though a solver's call never returned: waiting for its thread would never end."""
    import logging
    import os
    import sys

    from runtime.support import logs

    logging.getLogger("phasestack.run").warning("a call that never returned is left to the system")
    logs.flush()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    os._exit(0)


def run(
    config: Annotated[Path | None, typer.Option(help="TOML file; see `phasestack config`")] = None,
    replay: Annotated[str | None, typer.Option(help="a recording, or `demo`, instead of the sensor")] = None,
    headless: Annotated[bool, typer.Option("--headless", help="offscreen panels, whatever is configured")] = False,
    frames: Annotated[int | None, typer.Option(min=1, help="stop after so many refreshes")] = None,
    max_speed: Annotated[
        bool, typer.Option("--max-speed", help="a recording on a simulated clock, no waiting: reproducible")
    ] = False,
    out: Annotated[Path | None, typer.Option(help="folder for pictures, frames.jsonl and summary.json")] = None,
    scene: Annotated[str | None, typer.Option(help="a built-in scene, a preset's name, a file or folder")] = None,
    model: Annotated[str | None, typer.Option(help="fast, balanced, best, sart or an ONNX file")] = None,
    scale: Annotated[float, number(0.05, 2.0, help="panel resolution, times the configured one")] = 1.0,
    budget_ms: Annotated[
        float | None, number(0, BUDGET_MOST_MS, "ms", help="time for a frame; picks model and size")
    ] = None,
    backend: Annotated[
        str | None, typer.Option(help="what surrounds the network: auto (the faster one here), opencv or gl")
    ] = None,
    keep_light: Annotated[
        int, typer.Option(min=0, help="with --out: every so many refreshes leave what the panels show; 0: none")
    ] = 0,
    record: Annotated[
        Path | None, typer.Option(help="everything into this MCAP file, for Foxglove and for --replay")
    ] = None,
    record_images: Annotated[
        bool, typer.Option("--record-images", help="with --record: the sensor's pictures too, faces among them")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="the summary as one JSON object on stdout")] = False,
) -> None:
    """Run the display: eyes in, layers out, until SIGTERM. SIGHUP reads the configuration again.

    Exits with 75 where the X server dies: start it again, and it waits for the server.

    Example: phasestack run --config /etc/phasestack/phasestack.toml

    Example: phasestack run --replay demo --headless --max-speed --frames 30 --out out/run

    Example: phasestack run --replay demo --headless --record out/run.mcap
    """
    from runtime.support.interrupts import imports_end_at_once

    with imports_end_at_once():
        from runtime.config import Overrides
        from runtime.daemon.supervise import run_daemon
        from runtime.errors import InputError

    if keep_light and out is None:
        raise InputError("run", "--keep-light", "needs --out")
    if record_images and record is None:
        raise InputError("run", "--record-images", "needs --record")
    if record is not None:
        from runtime.commands.record import refuse_target

        refuse_target(record, force=True, source="run", field="--record")
    overrides = Overrides(
        replay=replay, headless=headless, scene=scene, model=model, budget_ms=budget_ms, backend=backend
    )
    with told_by_option("run", scene=scene, model=model):
        summary = run_daemon(
            config,
            overrides,
            frames=frames,
            max_speed=max_speed,
            out=out,
            scale=scale,
            quiet=as_json,
            keep_light=keep_light,
            record=record,
            record_images=record_images,
        )
    left_behind = summary.pop("left_behind", 0)
    if as_json:
        typer.echo(json.dumps(summary))
    if left_behind:
        leave_at_once()
