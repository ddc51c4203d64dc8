"""`phasestack plan`: list the work that a scene makes unnecessary."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from runtime.support.options import blame_option, number


def plan(
    config: Annotated[Path | None, typer.Option(help="TOML file; see `phasestack config`")] = None,
    scene: Annotated[str | None, typer.Option(help="a built-in scene, a file or folder")] = None,
    model: Annotated[str | None, typer.Option(help="fast, balanced, best, sart or an ONNX file")] = None,
    scale: Annotated[float, number(0.05, 2.0, help="scale factor of the panels' pixel counts")] = 1.0,
    as_json: Annotated[bool, typer.Option("--json", help="one JSON object on stdout")] = False,
) -> None:
    """List the work that this scene makes unnecessary, with reasons and measured savings and costs.

    The scene is drawn and solved about twenty times on the full raster: seconds at 960x540, minutes at 4K without a GPU
    (--scale 0.25 is sixteen times as fast).

    Example: phasestack plan --scene sparse
    """
    from runtime.plan.measure import plan_for
    from runtime.support.figures import shown

    with blame_option("plan", scene=scene, model=model):
        result = plan_for(config, scene=scene, model=model, scale=scale)
    typer.echo(shown(result, as_json=as_json))
