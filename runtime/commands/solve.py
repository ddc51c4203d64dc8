"""`phasestack solve`: compute the layers for still pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from runtime.support.options import blame_option, number, place
from runtime.support.ranges import FOV_RANGE_DEG


def solve(
    out: Annotated[Path, typer.Option(help="folder to write the layers to")],
    left: Annotated[
        Path | None, typer.Option(help="picture taken by a pinhole camera at the left eye, aimed at the stack's origin")
    ] = None,
    panels: Annotated[
        Path | None, typer.Option(help="TOML or JSON file with the stack geometry (width_m, height_m and x_m)")
    ] = None,
    case: Annotated[
        Path | None,
        typer.Option(
            help="case file with panels, eyes, images and fov, for any number of eyes (replaces the options for the "
            "pictures, the eyes and the panels)"
        ),
    ] = None,
    right: Annotated[Path | None, typer.Option(help="the right eye's picture, unless --left contains both")] = None,
    layout: Annotated[str | None, typer.Option(help="views in --left (values of the content.layout setting)")] = None,
    left_eye: Annotated[
        tuple[float, float, float] | None, place(help="position of the left eye in the stack frame, in metres")
    ] = None,
    right_eye: Annotated[
        tuple[float, float, float] | None, place(help="position of the right eye in the stack frame, in metres")
    ] = None,
    camera: Annotated[
        Path | None,
        typer.Option(
            help="for cameras aimed elsewhere: TOML or JSON file with 3x4 matrices `left` and `right` that map metres "
            "in the stack frame to pixels (replaces --left-eye, --right-eye and --fov)"
        ),
    ] = None,
    fov: Annotated[
        float, number(*FOV_RANGE_DEG, "degrees", help="horizontal field of view of the pictures in degrees")
    ] = 40.0,
    model: Annotated[str, typer.Option(help="model to use: fast, balanced, best, sart or an ONNX file")] = "balanced",
    repeat: Annotated[int, typer.Option(min=1, max=10000, help="number of timed runs after the warm-up")] = 1,
    eye_sigma_mm: Annotated[
        float, number(0, 1000, "mm", help="expected tracking error on each axis in mm (about 1 for a good tracker)")
    ] = 1.0,
    backend: Annotated[
        str | None,
        typer.Option(
            help="device for everything except the network: cpu, gl or auto (times both if --repeat is at least 10)"
        ),
    ] = None,
    no_plan: Annotated[bool, typer.Option("--no-plan", help="solve every pixel, even where it is unnecessary")] = False,
    floats: Annotated[bool, typer.Option("--floats", help="also write layers.npy, not rounded to 8 bits")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="print the contents of solve.json")] = False,
) -> None:
    """Compute the layers for still pictures, and measure how well each eye sees its picture.

    Example: phasestack solve --left l.png --right r.png --left-eye 0.6 -0.03 0 --right-eye 0.6 0.03 0 --fov 40
    --panels panels.json --out out/solve

    For any number of eyes: phasestack solve --case case.json --out out/solve
    """
    from runtime.clock import Stopwatch
    from runtime.commands.solving import Eyes, asked_for, case_asked_for, solve_pictures
    from runtime.support.figures import shown

    with blame_option("solve", model=model):
        watch = Stopwatch()
        if case is not None:
            names = ("--left", "--right", "--layout", "--panels", "--camera", "--left-eye", "--right-eye")
            given = zip(names, (left, right, layout, panels, camera, left_eye, right_eye))
            asked = case_asked_for(case, [option for option, value in given if value is not None])
        else:
            asked = asked_for(left, right, layout, Eyes(left_eye, right_eye, fov, camera), panels)
        watch.lap("read pictures")
        result = solve_pictures(
            asked,
            out,
            watch,
            is_resampled=camera is not None,
            model=model,
            repeat=repeat,
            eye_sigma_mm=eye_sigma_mm,
            backend=backend,
            plan=not no_plan,
            floats=floats,
        )
    typer.echo(shown(result, as_json=as_json))
    if not as_json:
        typer.echo("the figure to quote is light_db, which assumes a tracking error of 1 mm")
        typer.echo(f"see {out / 'contact-sheet.png'}, or open {out / 'viewer.html'} to look around")
