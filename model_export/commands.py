"""`phasestack train`, `export` and `validate`: names and options; torch is imported when they run."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from runtime.errors import InputError, MissingPart
from runtime.support.options import number


def require(*modules: str) -> None:
    """Raises MissingPart, naming what to install, where a module of the `export` extra is not there."""
    for module in modules:
        if importlib.util.find_spec(module) is None:
            what = "tensorboard" if module == "tensorboard" else "'phasestack[export]'"
            raise MissingPart(f"{module} is not installed: pip install {what}")


Arch = Annotated[
    str, typer.Option(help="eyereal, unrolled, or module:Class, a torch.nn.Module of your own on Python's path")
]
Options = Annotated[
    list[str] | None,
    typer.Option(
        "--option",
        metavar="NAME=VALUE",
        help="of the network's own Options, or steps=N, of the solver after it; repeatable",
    ),
]


def train(
    out: Annotated[Path, typer.Option(help="folder for checkpoint.pth, curve.csv and curve.png")],
    arch: Arch,
    option: Options = None,
    data: Annotated[
        Path | None, typer.Option(help="folder of pairs in EyeReal's form; without: procedural ones")
    ] = None,
    scene: Annotated[str, typer.Option(help="a scene or file that the runtime draws, turned, from anywhere")] = "",
    pairs: Annotated[int, typer.Option(min=0, help="only so many pairs; 0: ever new ones")] = 0,
    panels: Annotated[Path | None, typer.Option(help="panels to learn for; without: any three even ones")] = None,
    iterations: Annotated[int, typer.Option(min=1, help="of gradients, in all")] = 2000,
    batch: Annotated[int, typer.Option(min=1, help="pairs of an iteration")] = 1,
    learning_rate: Annotated[float, number(1e-8, 1, help="at first; then along a cosine to none")] = 1e-3,
    width: Annotated[int, typer.Option(min=32, max=8192, help="of the panels and pictures learned from, pixels")] = 480,
    height: Annotated[int, typer.Option(min=32, max=8192, help="of the same")] = 270,
    eye_sigma_mm: Annotated[float, number(0, 20, "mm", help="how far eyes are from where they are believed")] = 1.0,
    seed: Annotated[int, typer.Option(min=0, help="of weights and pairs")] = 1,
    validate_every: Annotated[int, typer.Option(min=1, help="iterations from point to point of the curve")] = 100,
    device: Annotated[Literal["auto", "cpu", "cuda"], typer.Option(help="auto: a GPU where torch sees one")] = "auto",
    resume: Annotated[bool, typer.Option("--resume", help="go on from --out's checkpoint")] = False,
    tensorboard: Annotated[bool, typer.Option("--tensorboard", help="event files besides")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="the result as one object on stdout")] = False,
) -> None:
    """Train a network of pictures by gradients, by the light that eyes get of its panels.

    Example: phasestack train --arch my_network:MyNetwork --out out/mine
    """
    require("torch", *(["tensorboard"] if tensorboard else []))
    from model_export.train import Training, run_training
    from runtime.config import validated
    from runtime.support.figures import shown

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
    result = run_training(out, training, device=device, resume=resume, tensorboard=tensorboard)
    typer.echo(shown(result, as_json=as_json))


def options_of(given: list[str] | None) -> dict[str, Any]:
    """NAME=VALUE, each value as JSON has it, or a text. Raises InputError."""
    found: dict[str, Any] = {}
    for text in given or []:
        name, equals, value = text.partition("=")
        if not (name and equals):
            raise InputError("--option", "", f"{text!r} is no NAME=VALUE")
        try:
            found[name] = json.loads(value)
        except ValueError:
            found[name] = value
    return found


def export(
    arch: Annotated[str, typer.Option(help="fast, balanced, best, eyereal, unrolled, or module:Class")],
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
    option: Options = None,
    as_json: Annotated[bool, typer.Option("--json", help="the checks as one object on stdout")] = False,
) -> None:
    """Write a model as ONNX with its contract, if it agrees with torch.

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
        options=options_of(option),
    )
    typer.echo(report.json() if as_json else report.table())
    if not report.passed:
        typer.echo(f"{out}: not written: a check failed", err=True)
        raise typer.Exit(1)


def validate(
    file: Annotated[Path, typer.Argument(help="the ONNX file")],
    as_json: Annotated[bool, typer.Option("--json", help="the checks as one object on stdout")] = False,
) -> None:
    """Check a model file: contract, names, shapes, and finite values on stress inputs.

    Exits with 1 where a check fails.

    Example: phasestack validate runtime/model/data/balanced.onnx
    """
    require("onnx")
    from model_export.validate import validate_file

    report = validate_file(file)
    typer.echo(report.json() if as_json else report.table())
    if not report.passed:
        raise typer.Exit(1)
