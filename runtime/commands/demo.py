"""`phasestack demo`: run the display loop on the built-in recording and scene."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Annotated

import typer

from runtime.support.options import JsonOption

FRAMES, MEASURED_EVERY = 42, 14  # in refreshes; in 0.7 s, the head has started to move
LONGEST_S, LEAST = 45.0, 15  # the demo's time limit; minimum number of refreshes


def demo(
    out: Annotated[Path, typer.Option(help="folder for pictures, frames.jsonl and summary.json")] = Path("out/demo"),
    frames: Annotated[int, typer.Option(min=1, help="refreshes to show (the full recording has 600)")] = FRAMES,
    verbose: Annotated[bool, typer.Option("--verbose", help="print all figures of the summary")] = False,
    as_json: JsonOption = False,
) -> None:
    """Play a built-in recording of a moving head through the whole pipeline without a screen.

    By default, the demo ends after 42 refreshes or, on a slow machine, after 45 s and at least 15 refreshes.

    Example: phasestack demo --out out/demo
    """
    from runtime.config import Settings, changed
    from runtime.daemon.build import Host, RunOptions
    from runtime.daemon.drive import drive, print_summary, refuse_lost_output

    class InTime(Host):
        """Host that ends the demo after a time limit on slow machines."""

        def __init__(self) -> None:
            self._ends_s = time.monotonic() + LONGEST_S if frames <= FRAMES else float("inf")
            self._asked = 0  # how often `stop_reason` was called, once per refresh

        def stop_reason(self) -> str:
            self._asked += 1
            is_over = self._asked >= LEAST and time.monotonic() > self._ends_s
            more = "--frames 600 plays the whole recording without a limit"
            shown = f"after {self._asked} of {frames} refreshes"
            return f"the time limit of {LONGEST_S:g} s ended the demo {shown}; {more}" if is_over else ""

    every = MEASURED_EVERY if frames <= 4 * FRAMES else 60  # one measurement takes as long as ten refreshes
    settings = changed(Settings(), "loop", {"evaluate_every": every}, source="demo")
    settings = changed(settings, "content", {"scene": "room"}, source="demo")
    summary = drive(settings, RunOptions(max_speed=True, measure=True, frames=frames, out=out), InTime())
    if as_json:
        typer.echo(json.dumps(summary))
    else:
        print_summary(summary, out, asked=frames, verbose=verbose)
    refuse_lost_output(summary)
