"""`phasestack try`: try the display without hardware."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from runtime.support.options import blame_option, number


def try_(
    config: Annotated[Path | None, typer.Option(help="TOML file; default: panels of 960x540")] = None,
    scene: Annotated[str | None, typer.Option(help="a built-in scene, a file or folder")] = None,
    layout: Annotated[
        str | None, typer.Option(help="arrangement of the views in pictures: a value of content.layout")
    ] = None,
    model: Annotated[str | None, typer.Option(help="fast, balanced, best, sart or an ONNX file")] = None,
    webcam: Annotated[bool, typer.Option("--webcam", help="track your head with this PC's camera")] = False,
    port: Annotated[int, typer.Option(min=0, max=65535, help="port to listen on; 0: any free one")] = 0,
    no_browser: Annotated[bool, typer.Option("--no-browser", help="print the address only")] = False,
    seconds: Annotated[float | None, number(1, 1e6, "s", help="stop after this long")] = None,
    as_json: Annotated[bool, typer.Option("--json", help='print {"url": ...} as soon as the page is served')] = False,
) -> None:
    """Try the display without hardware: the daemon's own loop, with a browser as both viewer and panels.

    Example: phasestack try
    """
    from runtime.commands.trying import settings_of, try_display

    with blame_option("try", scene=scene, model=model):
        settings = settings_of(config, scene=scene, layout=layout, model=model, webcam=webcam)
        try_display(settings, port=port, opens=not no_browser, seconds=seconds, as_json=as_json)
