"""`phasestack doctor`: is everything there that the configuration asks for, and what to do where it is not?"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


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
        for row in rows:
            remedy = f"\n      to do: {row.remedy}" if row.remedy else ""
            typer.echo(f"{row.state:5} {row.name}: {row.detail}{remedy}")
    if failed:
        raise typer.Exit(1)
