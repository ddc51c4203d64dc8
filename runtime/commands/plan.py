"""`phasestack plan`: what this scene leaves out, and why."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from runtime.support.options import number, place, told_by_option
from runtime.support.ranges import BUDGET_MOST_MS


def plan(
    config: Annotated[Path | None, typer.Option(help="TOML file; see `phasestack config`")] = None,
    scene: Annotated[str | None, typer.Option(help="a preset's name, a built-in scene, a file or folder")] = None,
    model: Annotated[str | None, typer.Option(help="fast, balanced, best, sart or an ONNX file")] = None,
    scale: Annotated[float, number(0.05, 2.0, help="panel resolution, times the configured one")] = 1.0,
    budget_ms: Annotated[
        float | None, number(0, BUDGET_MOST_MS, "ms", help="time for a frame; picks model and size")
    ] = None,
    eyes: Annotated[tuple[float, float, float] | None, place(help="between the eyes, metres, frame `stack`")] = None,
    survey: Annotated[
        bool, typer.Option("--survey", help="six kinds of scenes, the plan on and off, and cost against region size")
    ] = False,
    out: Annotated[Path | None, typer.Option(help="with --survey: folder for table, plots and JSON")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="with --survey: half the resolution, fewer repeats")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="one JSON object on stdout")] = False,
) -> None:
    """What this scene leaves out, why, what each saving saves and what it costs, measured here.

    Example: phasestack plan --scene sparse

    Example: phasestack plan --scene lego_bulldozer --budget-ms 40 --json

    Example: phasestack plan --survey --out out/plan
    """
    if survey or out is not None or quick:
        _survey(config, survey, out, scene, model, scale, budget_ms, eyes, quick, as_json)
        return
    from runtime.plan.planning import plan_for

    with told_by_option("plan", scene=scene, model=model):
        result = plan_for(
            config, scene=scene, model=model, scale=scale, budget_ms=budget_ms, middle_m=eyes, quiet=as_json
        )
    if as_json:
        typer.echo(json.dumps(result))
    else:
        _print(result)


def _survey(
    config: Path | None,
    survey: bool,
    out: Path | None,
    scene: str | None,
    model: str | None,
    scale: float,
    budget_ms: float | None,
    eyes: tuple[float, float, float] | None,
    quick: bool,
    as_json: bool,
) -> None:
    from runtime.errors import InputError
    from runtime.report.survey_run import survey as survey_to

    if not survey:
        raise InputError("plan", "--survey", "--out and --quick belong to it")
    if out is None:
        raise InputError("plan", "--out", "--survey needs a folder for its files")
    for option, value in (("--scene", scene), ("--budget-ms", budget_ms), ("--eyes", eyes)):
        if value is not None:
            raise InputError("plan", option, "is of no use with --survey, which has scenes and a viewer of its own")
    result = survey_to(config, out=out, model=model, scale=scale, quick=quick, quiet=as_json)
    if as_json:
        typer.echo(json.dumps(result))
    else:
        _print_survey(result, out)


def _print_survey(result: dict[str, Any], out: Path) -> None:
    from rich.console import Console
    from rich.table import Table

    from runtime.report.survey_page import HEADINGS, cells

    console = Console()
    table = Table(*HEADINGS)
    for row in (*result["scenes"], *result["other_sparse"]):
        table.add_row(*cells(row))
    console.print(table)
    console.print(f"{out}")


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
    if result["levels"]:
        levels = Table("model and resolution", "ms", "dB", "chosen")
        for level in result["levels"]:
            mark = "*" if level["label"] == result["level"] else ""
            levels.add_row(level["label"], f"{level['ms']:.1f}", f"{level['psnr_db']:.2f}", mark)
        console.print(levels)


def _number(value: float | None, digits: int) -> str:
    """Empty where nothing was measured."""
    return "" if value is None else f"{value:.{digits}f}"
