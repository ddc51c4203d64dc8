"""`phasestack setup`: set up a new display, step by step."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def setup(
    config: Annotated[Path, typer.Option(help="configuration file to create or change")] = Path("phasestack.toml"),
    out: Annotated[Path, typer.Option(help="folder for point pairs, the calibration, reports and setup.json")] = Path(
        "setup"
    ),
    photos: Annotated[Path, typer.Option(help="folder containing your photographs of the panels")] = Path("photos"),
    simulate: Annotated[bool, typer.Option("--simulate", help="try the setup on a simulated display")] = False,
    seed: Annotated[int, typer.Option(min=0, help="random seed for the simulated display")] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="print the result as a JSON object at the end")] = False,
) -> None:
    """Set up a display: monitors, sizes, panel registration, grey curves and sensor calibration.

    Answer in the terminal, or press keys in the panels' windows. Every step can be skipped or repeated. If you quit
    with q, run the same command again to continue where you stopped. The result is a valid configuration, and a record
    of each step's figures.

    Example: phasestack setup --simulate --config try.toml --out try
    """
    from calib.setup_run import run_setup

    summary, text = run_setup(config, out=out, photos=photos, simulate=simulate, seed=seed, to_stderr=as_json)
    if as_json:
        from runtime.support.artifacts import to_json

        typer.echo(to_json(summary))
    else:
        typer.echo("\n" + text)
