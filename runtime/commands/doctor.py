"""`phasestack doctor`: is everything there that the configuration asks for, and what to do where it is not?"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from runtime.commands.doctor_checks import Row

COLOURS = {"ok": "green", "warn": "yellow", "fail": "red", "skip": "dim"}


def doctor(
    config: Annotated[Path | None, typer.Option(help="configuration to check; without one, the defaults")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="one JSON object on stdout")] = False,
) -> None:
    """Check settings, sensor, permissions, OpenGL, monitors and their binding, scene, model, calibration, the service.

    What is only unusual is a warning. Exits with 1 where a check fails.

    Example: phasestack doctor --config /etc/phasestack/phasestack.toml
    """
    import json
    from dataclasses import asdict

    from runtime.commands.doctor_checks import examine
    from runtime.config import load_settings

    rows = examine(load_settings(config))
    failed = sum(row.state == "fail" for row in rows)
    if as_json:
        typer.echo(json.dumps({"ok": not failed, "checks": [asdict(row) for row in rows]}))
    else:
        _print(rows)
    if failed:
        raise typer.Exit(1)


def _print(rows: list[Row]) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    table = Table(expand=False)
    for title in ("check", "state", "what was found", "what to do"):
        table.add_column(title, overflow="fold")  # a path or a command is of no use without its end
    for row in rows:
        colour = COLOURS[row.state]
        table.add_row(row.name, f"[{colour}]{row.state}[/]", escape(row.detail), escape(row.remedy))
    Console().print(table)
