"""The commands `phasestack train`, `export` and `validate`. Torch is imported only when they run."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from runtime.errors import InputError, MissingPart
from runtime.support.options import JsonOption, number


def require(*modules: str) -> None:
    """Raise MissingPart if a module is not installed. The message names the extra to install."""
    for module in modules:
        if importlib.util.find_spec(module) is None:
            raise MissingPart(f"{module} is not installed; run: pip install 'phasestack[export]'")


Arch = Annotated[str, typer.Option(help="eyereal, unrolled, or module:Class for your own torch.nn.Module")]
Options = Annotated[
    list[str] | None,
    typer.Option(
        "--option",
        metavar="NAME=VALUE",
        help="network option as NAME=VALUE, or steps=N for the number of solver steps after the network (can be "
        "repeated)",
    ),
]


def train(
    out: Annotated[Path, typer.Option(help="folder for checkpoint.pth, curve.csv and curve.png")],
    arch: Arch,
    option: Options = None,
    data: Annotated[
        Path | None,
        typer.Option(help="folder containing pairs in EyeReal's format (default: procedurally generated pairs)"),
    ] = None,
    scene: Annotated[str, typer.Option(help="scene or file to draw at random rotations and eye positions")] = "",
    pairs: Annotated[int, typer.Option(min=0, help="number of different pairs (0 for unlimited)")] = 0,
    panels: Annotated[
        Path | None, typer.Option(help="file with the geometry of the panels (default: random stacks of three panels)")
    ] = None,
    iterations: Annotated[int, typer.Option(min=1, help="total number of gradient steps")] = 2000,
    batch: Annotated[int, typer.Option(min=1, help="pairs per iteration")] = 1,
    learning_rate: Annotated[float, number(1e-8, 1, help="initial learning rate, with cosine decay to zero")] = 1e-3,
    width: Annotated[int, typer.Option(min=32, max=8192, help="width of training panels and pictures in pixels")] = 480,
    height: Annotated[
        int, typer.Option(min=32, max=8192, help="height of training panels and pictures in pixels")
    ] = 270,
    eye_sigma_mm: Annotated[float, number(0, 20, "mm", help="standard deviation of the tracking error in mm")] = 1.0,
    seed: Annotated[int, typer.Option(min=0, help="random seed for weights and pairs")] = 1,
    validate_every: Annotated[int, typer.Option(min=1, help="number of iterations between points on the curve")] = 100,
    device: Annotated[
        Literal["auto", "cpu", "cuda"], typer.Option(help="device to train on (auto uses a GPU if torch finds one)")
    ] = "auto",
    resume: Annotated[bool, typer.Option("--resume", help="continue from the checkpoint in --out")] = False,
    as_json: JsonOption = False,
) -> None:
    """Train a picture network by gradient descent on the light that reaches the eyes.

    Example: phasestack train --arch my_network:MyNetwork --out out/mine
    """
    require("torch")
    from model_export.train import Training, run_training
    from runtime.config import validated
    from runtime.support.artifacts import refuse_unwritable
    from runtime.support.figures import shown

    refuse_unwritable(out)
    settings = {
        "arch": arch,
        "options": options_of(option),
        "data": str(data or ""),
        "scene": scene,
        "panels": str(panels or ""),
        "pairs": pairs,
        "iterations": iterations,
        "batch": batch,
        "learning_rate": learning_rate,
        "width_px": width,
        "height_px": height,
        "eye_sigma_mm": eye_sigma_mm,
        "seed": seed,
        "validate_every": validate_every,
    }
    training = validated(Training, settings, source="train")
    result = run_training(out, training, device=device, resume=resume)
    if result:  # other processes of torchrun have none
        typer.echo(shown(result, as_json=as_json))


def options_of(texts: list[str] | None) -> dict[str, Any]:
    """Parse options of the form NAME=VALUE. Values that are not JSON are taken as text.

    Raises InputError if an option has a different form.
    """
    options: dict[str, Any] = {}
    for text in texts or []:
        name, equals, value = text.partition("=")
        if not (name and equals):
            raise InputError("--option", "", f"must have the form NAME=VALUE, not {text!r}")
        try:
            options[name] = json.loads(value)
        except ValueError:
            options[name] = value
    return options


def export(
    arch: Annotated[str, typer.Option(help="fast, balanced, best, eyereal, unrolled, or module:Class")],
    out: Annotated[Path, typer.Option(help="ONNX file to write")],
    checkpoint: Annotated[
        Path | None, typer.Option(help="weights from `phasestack train`, or the published weights for eyereal")
    ] = None,
    random_init: Annotated[
        int | None, typer.Option(min=0, help="use untrained weights generated from this seed")
    ] = None,
    width: Annotated[int, typer.Option(help="width of the panels in pixels")] = 1920,
    height: Annotated[int, typer.Option(help="height of the panels in pixels")] = 1080,
    eye_order: Annotated[
        Literal["left-right", "right-left"], typer.Option(help="for eyereal: order of the eyes in the training data")
    ] = "left-right",
    option: Options = None,
    as_json: JsonOption = False,
) -> None:
    """Write a model and its contract to an ONNX file, provided that its results agree with torch's.

    fast, balanced and best are built from their recipes, without --checkpoint or --random-init. Exits with 1 if a check
    fails.

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
        options=options_of(option),
    )
    typer.echo(report.json() if as_json else report.table())
    if not report.passed:
        typer.echo(f"{out} was not written because a check failed", err=True)
        raise typer.Exit(1)


def validate(file: Annotated[Path, typer.Argument(help="ONNX file to check")], as_json: JsonOption = False) -> None:
    """Check that a model file meets its contract and gives valid results for extreme inputs.

    Exits with 1 if a check fails.

    Example: phasestack validate runtime/model/data/balanced.onnx
    """
    require("onnx")
    from model_export.validate import validate_file

    report = validate_file(file)
    typer.echo(report.json() if as_json else report.table())
    if not report.passed:
        raise typer.Exit(1)
