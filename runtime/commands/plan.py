"""`phasestack plan`: what this scene leaves out, and why."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from runtime.support.options import blame_option, number


def plan(
    config: Annotated[Path | None, typer.Option(help="TOML file; see `phasestack config`")] = None,
    scene: Annotated[str | None, typer.Option(help="a preset's name, a built-in scene, a file or folder")] = None,
    model: Annotated[str | None, typer.Option(help="fast, balanced, best, sart or an ONNX file")] = None,
    scale: Annotated[float, number(0.05, 2.0, help="panel resolution, times the configured one")] = 1.0,
    as_json: Annotated[bool, typer.Option("--json", help="one JSON object on stdout")] = False,
) -> None:
    """What this scene leaves out, why, what each saving saves and what it costs, measured here.

    Example: phasestack plan --scene sparse
    """
    from rich.console import Console

    from runtime.plan.planning import plan_for

    status = Console(stderr=True, quiet=as_json).status("measuring with and without the plan")
    with blame_option("plan", scene=scene, model=model), status:
        result = plan_for(config, scene=scene, model=model, scale=scale)
    if as_json:
        typer.echo(json.dumps(result))
    else:
        _print(result)


def _print(result: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console()
    console.print(
        f"scene {result['scene']}, model {result['model']} ({result['backend']}), "
        f"{result['width_px']} x {result['height_px']}"
    )
    table = Table("left out", "why", "saves ms", "costs dB")
    drifted = result["psnr_db_drifted"]
    for item in result["plan"]:
        costs = _number(item["costs_db"], 2)
        if drifted is not None and item["what"] == "render and inference":
            costs = f"0, and {costs} after a drift of {result['drift_mm']:g} mm"
        table.add_row(item["what"], item["why"], _number(item["saves_ms"], 1), costs)
    console.print(table)
    console.print(f"one frame: {result['frame_ms']:.1f} ms with the plan, {result['frame_ms_without']:.1f} ms without")
    console.print(
        f"displayed to the eyes that were solved for: {result['psnr_db']:.2f} dB with, "
        f"{result['psnr_db_without']:.2f} dB without"
    )
    if drifted is not None:
        console.print(
            f"to a resting head that has drifted by {result['drift_mm']:g} mm, just before its picture is renewed: "
            f"{drifted:.2f} dB"
        )


def _number(value: float | None, digits: int) -> str:
    """Empty where nothing was measured."""
    return "" if value is None else f"{value:.{digits}f}"
