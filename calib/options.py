"""What the `phasestack calibrate` commands share: options, the geometry they name, and how a result is told."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from runtime.config import Settings
    from runtime.optics.stack import PanelStack

ConfigOption = Annotated[Path | None, typer.Option(help="configuration TOML; without it the defaults hold")]
PanelsOption = Annotated[Path | None, typer.Option(help="panel geometry, TOML or JSON; else the configuration's")]
JsonOption = Annotated[bool, typer.Option("--json", help="one JSON object on stdout")]


def settings_and_stack(config: Path | None, panels: Path | None = None) -> tuple[Settings, PanelStack]:
    """The settings of a configuration, and the stack of `panels` where it is given. Raises InputError."""
    from runtime.config import load_settings, load_stack

    settings = load_settings(config)
    geometry = settings.stack
    if panels is None:
        return settings, geometry.stack()
    return settings, load_stack(panels, width_px=geometry.width_px, height_px=geometry.height_px)


def tell(summary: dict[str, Any], as_json: bool, text: str) -> None:
    """Print a command's summary as one JSON object, or its text for a person."""
    if not as_json:
        typer.echo(text)
        return
    from runtime.support.artifacts import to_json

    typer.echo(to_json(summary))
