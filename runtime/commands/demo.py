"""`phasestack demo`: the main job on the built-in recording and scene."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer


def demo(
    out: Annotated[Path, typer.Option(help="folder for pictures, frames.jsonl and summary.json")] = Path("out/demo"),
    frames: Annotated[int | None, typer.Option(min=1, help="refreshes; default: the whole recording")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="the summary as one JSON object on stdout")] = False,
) -> None:
    """Replay a built-in recording of a moving head through the whole pipeline, without a screen.

    Example: phasestack demo --out out/demo
    """
    from runtime.config import Settings, changed
    from runtime.daemon.build import RunOptions
    from runtime.daemon.drive import drive, print_summary

    # Comparing takes as long as ten refreshes: once a second is enough of a head that comes and goes for ten.
    settings = changed(Settings(), "loop", {"evaluate_every": 60}, source="demo")
    summary = drive(settings, RunOptions(max_speed=True, measure=True, frames=frames, out=out))
    if as_json:
        typer.echo(json.dumps(summary))
    else:
        print_summary(summary, out)
