"""`phasestack solve`: compute the layers for one still stereo pair."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from runtime.support.options import blame_option, number, place
from runtime.support.ranges import FOV_RANGE_DEG


def solve(
    left: Annotated[
        Path, typer.Option(help="picture of a pinhole camera at the left eye, looking at the stack's origin")
    ],
    panels: Annotated[Path, typer.Option(help="TOML or JSON: width_m, height_m, x_m")],
    out: Annotated[Path, typer.Option(help="folder for the layers")],
    right: Annotated[Path | None, typer.Option(help="picture for the right eye; none: --left contains both")] = None,
    layout: Annotated[str | None, typer.Option(help="arrangement of both views in --left (see content.layout)")] = None,
    left_eye: Annotated[tuple[float, float, float] | None, place(help="left eye, metres, stack frame")] = None,
    right_eye: Annotated[tuple[float, float, float] | None, place(help="right eye, metres")] = None,
    camera: Annotated[
        Path | None,
        typer.Option(
            help="instead of eyes and --fov, for other cameras: TOML or JSON with `left` and `right`, 3x4 matrices "
            "from metres of the stack's frame to pixels"
        ),
    ] = None,
    fov: Annotated[
        float, number(*FOV_RANGE_DEG, "degrees", help="horizontal field of view of the pictures, degrees")
    ] = 40.0,
    model: Annotated[str, typer.Option(help="fast, balanced, best, sart or an ONNX file")] = "balanced",
    repeat: Annotated[int, typer.Option(min=1, max=10000, help="timed runs, after the warm-up")] = 1,
    eye_sigma_mm: Annotated[
        float, number(0, 1000, "mm", help="tracking error, mm per axis; 1 for a good tracker, 0 for known eyes")
    ] = 1.0,
    backend: Annotated[
        str | None,
        typer.Option(help="device for everything except the network: cpu, gl or auto (timed if --repeat >= 10)"),
    ] = None,
    no_plan: Annotated[
        bool, typer.Option("--no-plan", help="do all work, even if the pictures make some of it unnecessary")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="solve.json's object on stdout")] = False,
) -> None:
    """Compute the layers for two still pictures and two eyes, and measure the quality of the eyes' views.

    Example: phasestack solve --left l.png --right r.png --left-eye 0.6 -0.03 0 --right-eye 0.6 0.03 0 --fov 40
    --panels panels.json --out out/solve
    """
    from runtime.commands.solving import Eyes, Files, solve_pair
    from runtime.support.figures import shown

    with blame_option("solve", model=model):
        result = solve_pair(
            Files(left, right, layout),
            Eyes(left_eye, right_eye, fov, camera),
            panels,
            out,
            model=model,
            repeat=repeat,
            eye_sigma_mm=eye_sigma_mm,
            backend=backend,
            plan=not no_plan,
        )
    typer.echo(shown(result, as_json=as_json))
    if not as_json:
        typer.echo("light_db at a tracking error of 1 mm is the figure to quote")
        typer.echo(f"see {out / 'contact-sheet.png'}; interactive: {out / 'viewer.html'}")
