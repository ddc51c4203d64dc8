"""`phasestack plan`: list the work that the solver can skip for a scene."""

from __future__ import annotations

from typing import Annotated

import typer

from runtime.support.options import ConfigOption, JsonOption, ModelOption, blame_option, number


def plan(
    config: ConfigOption = None,
    scene: Annotated[str | None, typer.Option(help="scene to show: a built-in name, a file or a folder")] = None,
    model: ModelOption = None,
    scale: Annotated[float, number(0.05, 2.0, help="scale factor for the pixel dimensions of the panels")] = 1.0,
    as_json: JsonOption = False,
) -> None:
    """List the work that the solver can skip for this scene, with reasons, time saved and quality lost.

    The scene is drawn and solved about twenty times at full size. This takes seconds at 960x540 but minutes at 4K
    without a GPU. With --scale 0.25, it is sixteen times as fast.

    Example: phasestack plan --scene sparse
    """
    from runtime.plan.measure import plan_for
    from runtime.support.figures import shown

    with blame_option("plan", scene=scene, model=model):
        result = plan_for(config, scene=scene, model=model, scale=scale)
    typer.echo(shown(result, as_json=as_json))
