"""`phasestack setup`: from the box to a picture, step by step."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def setup(
    config: Annotated[
        Path, typer.Option(help="configuration to write; one that is there is changed, the old one kept")
    ] = Path("phasestack.toml"),
    out: Annotated[Path, typer.Option(help="folder for pairs, calibration, reports and setup.json")] = Path("setup"),
    photos: Annotated[Path, typer.Option(help="folder in which the photographs will lie")] = Path("photos"),
    simulate: Annotated[bool, typer.Option("--simulate", help="a display that is not there, to try it out")] = False,
    seed: Annotated[int, typer.Option(min=0, help="of the simulated display")] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="one JSON object on stdout, at the end")] = False,
) -> None:
    """Set a display up: monitors, sizes, registration by photographs, grey curves, sensor, calibration.

    It asks in the terminal; where panels show something, keys on their windows count too. Every step can be skipped
    and repeated; q stops, and the same command goes on there. At the end: the figures of each step, and a
    configuration that is valid.

    Example: phasestack setup --simulate --config try.toml --out try
    """
    from calib.setup_run import run_setup

    summary, text = run_setup(config, out=out, photos=photos, simulate=simulate, seed=seed, to_stderr=as_json)
    if as_json:
        from runtime.support.artifacts import to_json

        typer.echo(to_json(summary))
    else:
        typer.echo("\n" + text)
