"""`phasestack eyes`: where the viewer's pupils are in pictures, films and recordings, or before the sensor now."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from runtime.support.options import number


def eyes(
    files: Annotated[
        list[Path] | None, typer.Argument(help="pictures, films, recordings; without one, the configured sensor, live")
    ] = None,
    config: Annotated[Path | None, typer.Option(help="configuration: the sensor")] = None,
    sequence: Annotated[
        bool, typer.Option("--sequence", help="the pictures are successive frames, followed as the daemon does")
    ] = False,
    rate_hz: Annotated[float, number(0.1, 1000, "Hz", help="of such frames, and of films that do not say")] = 30.0,
    out: Annotated[Path | None, typer.Option(help="folder for overlays, readable by you alone")] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="one JSON object on stdout; of the sensor, what two seconds showed")
    ] = False,
) -> None:
    """Find the viewer's pupils, with how sure each is, and draw them.

    Example: phasestack eyes me.jpg room.mp4 --out out/eyes
    """
    import json

    from runtime.commands.eyes_looking import look_at_files, look_at_sensor
    from runtime.config import load_settings

    settings = load_settings(config)
    if files:
        pictures = look_at_files(files, settings, sequence=sequence, rate_hz=rate_hz, out=out)
    else:
        pictures = look_at_sensor(settings, out=out, seconds=2.0 if as_json else None)
    if as_json:
        typer.echo(json.dumps({"pictures": pictures}))
    elif files:
        for row in pictures:
            where = row["file"] if row["frame"] is None else f"{row['file']}, frame {row['frame']}"
            typer.echo(f"{where}: {_in_words(row)}")


def _in_words(row: dict[str, object]) -> str:
    if row["eyes_px"] is None:
        return f"nobody ({row['reason']}), {row['ms']:.1f} ms"
    left, right = ([round(float(x), 1) for x in eye] for eye in row["eyes_px"])  # type: ignore[attr-defined]
    said = f", {row['reason']}" if row["reason"] else ""
    return f"left {left}, right {right}, sigma {row['sigma_px']:.2f} px, {row['seen']}, {row['ms']:.1f} ms{said}"
