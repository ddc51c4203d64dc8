"""`phasestack setup`: set up a new display, step by step."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def setup(
    config: Annotated[
        Path, typer.Option(help="configuration to write or change; a copy of the old one is kept")
    ] = Path("phasestack.toml"),
    out: Annotated[Path, typer.Option(help="folder for pairs, calibration, reports and setup.json")] = Path("setup"),
    photos: Annotated[Path, typer.Option(help="folder for the photographs")] = Path("photos"),
    simulate: Annotated[bool, typer.Option("--simulate", help="try the setup on a simulated display")] = False,
    seed: Annotated[int, typer.Option(min=0, help="seed of the simulated display")] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="one JSON object on stdout at the end")] = False,
) -> None:
    """Set up a display: monitors, sizes, registration from photographs, grey curves, sensor, calibration.

    Answer in the terminal, or with keys on the panels' windows. Every step can be skipped or repeated; q stops, and the
    same command resumes there. The result is a valid configuration, and the figures of each step.

    Example: phasestack setup --simulate --config try.toml --out try
    """
    from calib.setup_run import run_setup

    summary, text = run_setup(config, out=out, photos=photos, simulate=simulate, seed=seed, to_stderr=as_json)
    if as_json:
        from runtime.support.artifacts import to_json

        typer.echo(to_json(summary))
    else:
        typer.echo("\n" + text)
