"""`phasestack try`: try the display without hardware."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from runtime.support.options import LayoutOption, ModelOption, blame_option, number


def try_(
    config: Annotated[Path | None, typer.Option(help="configuration (default: panels of 960x540 pixels)")] = None,
    scene: Annotated[str | None, typer.Option(help="scene to show: a built-in name, a file or a folder")] = None,
    layout: LayoutOption = None,
    model: ModelOption = None,
    webcam: Annotated[bool, typer.Option("--webcam", help="track your head with this PC's webcam")] = False,
    port: Annotated[int, typer.Option(min=0, max=65535, help="port to listen on (0 for any free port)")] = 0,
    no_browser: Annotated[bool, typer.Option("--no-browser", help="print the address only")] = False,
    seconds: Annotated[float | None, number(1, 1e6, "s", help="stop after this many seconds")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="print the address as a JSON object")] = False,
) -> None:
    """Try the display without hardware. Your browser shows what a viewer would see.

    Example: phasestack try
    """
    from runtime.commands.trying import settings_of, try_display

    with blame_option("try", scene=scene, model=model):
        settings = settings_of(config, scene=scene, layout=layout, model=model, webcam=webcam)
        try_display(settings, port=port, opens=not no_browser, seconds=seconds, as_json=as_json)
