"""`phasestack eyes`: find the viewer's pupils in pictures, films, recordings or live frames."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from runtime.support.options import number

JSON_S = 2.0  # how long a live sensor is watched with --json


def eyes(
    files: Annotated[
        list[Path] | None, typer.Argument(help="pictures, films, recordings (default: the sensor)")
    ] = None,
    config: Annotated[Path | None, typer.Option(help="configuration file with the sensor to use")] = None,
    sequence: Annotated[bool, typer.Option("--sequence", help="follow the viewer from picture to picture")] = False,
    rate_hz: Annotated[float, number(0.1, 1000, "Hz", help="frame rate of pictures")] = 30.0,
    out: Annotated[Path | None, typer.Option(help="folder for annotated copies, which only you can read")] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="print one JSON object (a sensor is watched for 2 s)")
    ] = False,
) -> None:
    """Find the viewer's pupils and how uncertain their positions are. With --out, also draw them.

    Example: phasestack eyes me.jpg room.mp4 --out out/eyes
    """
    import json

    from rich.live import Live

    from runtime.commands.eyes_looking import look_at_files, look_at_sensor
    from runtime.config import load_settings
    from runtime.support.figures import in_words

    settings = load_settings(config)
    rows: list[dict[str, Any]] = []
    if files:
        rows = look_at_files(files, settings, sequence=sequence, rate_hz=rate_hz, out=out)
    elif as_json:
        look_at_sensor(settings, rows.append, out=out, seconds=JSON_S)
    else:
        with Live() as live:
            look_at_sensor(settings, lambda row: live.update(in_words(row)), out=out)
    if as_json:
        typer.echo(json.dumps({"pictures": rows}))
        return
    for row in rows:
        typer.echo(in_words(row))
