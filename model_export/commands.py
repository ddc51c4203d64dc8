"""`phasestack train`, `export` and `validate`: names and options; torch is imported when they run."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Annotated, Literal

import typer

from runtime.errors import MissingPart


def require(*modules: str) -> None:
    """Raises MissingPart, naming what to install, where a module of the `export` extra is not there."""
    for module in modules:
        if importlib.util.find_spec(module) is None:
            raise MissingPart(f"{module} is needed here and is not installed: pip install torch onnx onnxscript")


def train(
    out: Annotated[Path, typer.Option(help="folder for checkpoint.pth, recipe.json and validation.csv")],
    recipe: Annotated[str, typer.Option(help="fast, balanced, best or a recipe file (JSON)")] = "balanced",
    iterations: Annotated[int | None, typer.Option(min=1, help="numbers tried, at most; without: the recipe's")] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="of the pairs; without: the recipe's")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="the result as one object on stdout")] = False,
) -> None:
    """Train a model on procedural pairs: its weights and steps, by the light that eyes get of what it solves.

    Example: phasestack train --recipe balanced --out out/balanced
    """
    require("torch")
    from model_export.train import run_training
    from runtime.support.figures import shown

    result = run_training(out, recipe, iterations=iterations, seed=seed)
    typer.echo(shown(result, as_json=as_json))


def export(
    arch: Annotated[str, typer.Option(help="fast, balanced, best or eyereal")],
    out: Annotated[Path, typer.Option(help="the ONNX file")],
    checkpoint: Annotated[
        Path | None, typer.Option(help="weights: of `phasestack train`, or a published one for eyereal")
    ] = None,
    random_init: Annotated[int | None, typer.Option(min=0, help="untrained weights of this seed")] = None,
    width: Annotated[int, typer.Option(help="panels' width in pixels")] = 1920,
    height: Annotated[int, typer.Option(help="panels' height in pixels")] = 1080,
    eye_order: Annotated[
        Literal["left-right", "right-left"], typer.Option(help="eyereal: the eye that its data had first")
    ] = "left-right",
    as_json: Annotated[bool, typer.Option("--json", help="the checks as one object on stdout")] = False,
) -> None:
    """Write a model as ONNX with its contract, after checking it against torch; one that fails isn't written.

    Without --checkpoint or --random-init, fast, balanced and best are made from the recipes that ship.
    Exits with 1 where a check fails.

    Example: phasestack export --arch eyereal --checkpoint published.pth --out eyereal.onnx
    """
    require("torch", "onnx")
    from model_export.export import export_model

    report = export_model(
        arch,
        out,
        checkpoint=checkpoint,
        random_init=random_init,
        width_px=width,
        height_px=height,
        eye_order=eye_order,
    )
    typer.echo(report.json() if as_json else report.table())
    if not report.passed:
        typer.echo(f"{out}: not written: a check failed", err=True)
        raise typer.Exit(1)


def validate(
    file: Annotated[Path, typer.Argument(help="the ONNX file")],
    as_json: Annotated[bool, typer.Option("--json", help="the checks as one object on stdout")] = False,
) -> None:
    """Check a model file: contract, names, shapes, and finite values on stress inputs, with and without optimisation.

    Exits with 1 where a check fails.

    Example: phasestack validate runtime/model/data/balanced.onnx
    """
    require("onnx")
    from model_export.validate import validate_file

    report = validate_file(file)
    typer.echo(report.json() if as_json else report.table())
    if not report.passed:
        raise typer.Exit(1)
