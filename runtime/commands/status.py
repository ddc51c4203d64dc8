"""`phasestack status`: what the running daemon does, and why."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

HUNG_AFTER_S = 5.0


def status(
    config: Annotated[Path | None, typer.Option(help="configuration of the daemon: says where its socket is")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="one JSON object on stdout")] = False,
) -> None:
    """Ask the running daemon: its state and why, rates now, eyes and how sure they are, times, faults.

    Exits with 1 where no daemon answers, or its loop has stood still for five seconds.

    Example: phasestack status --json
    """
    from runtime.daemon.client import NotRunning, ask, sockets
    from runtime.support.figures import lines_of

    try:
        answer = ask(sockets(config), {"command": "status"})
    except NotRunning as error:
        typer.echo(json.dumps({"ok": False, "error": str(error)}) if as_json else str(error), err=not as_json)
        raise typer.Exit(1) from None
    if as_json:
        typer.echo(json.dumps(answer))
    else:
        for line in lines_of(answer):
            typer.echo(line)
    if float(answer.get("turn_age_s", 0.0)) > HUNG_AFTER_S:
        typer.echo(f"the loop has not completed a turn for {answer['turn_age_s']:.0f} s", err=True)
        raise typer.Exit(1)
