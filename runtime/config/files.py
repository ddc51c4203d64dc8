"""Load settings files and panels files, and override settings from the command line or by operators."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from runtime.config.settings import Settings, StackGeometry
from runtime.errors import InputError
from runtime.kernels import MAX_PANELS
from runtime.optics.stack import PanelStack
from runtime.support.sections import Section, read_table, validated

OLD_BACKENDS = {"opencv": "cpu"}  # names that old scripts give


def load_settings(path: Path | None) -> Settings:
    """Read settings from a file, or return the defaults. Raises InputError for the file or a setting."""
    if path is None:
        return Settings()
    return validated(Settings, read_table(path), source=path, folder=path.absolute().parent)


def load_stack(path: Path, *, width_px: int, height_px: int) -> PanelStack:
    """Read the stack's geometry from a file given with `--panels`, with these numbers of pixels if it
    gives none. Raises InputError if the file cannot be read, a field is missing or a value is invalid.
    """
    table = {"width_px": width_px, "height_px": height_px} | read_table(path)
    for name in ("width_m", "height_m", "x_m"):
        if name not in table:
            hint = "; in a panels file, move it from [stack] to the top level" if "stack" in table else ""
            raise InputError(path, name, f"is missing{hint}")
    if not 2 <= len(table["x_m"] if isinstance(table["x_m"], list) else ()) <= MAX_PANELS:
        raise InputError(path, "x_m", f"must list 2 to {MAX_PANELS} panels")
    return validated(StackGeometry, table, source=path).stack()


def with_options(
    settings: Settings,
    *,
    replay: str | None = None,
    loop: bool = False,
    headless: bool = False,
    scene: str | None = None,
    layout: str | None = None,
    model: str | None = None,
    backend: str | None = None,
) -> Settings:
    """Return the settings with command-line options other than None and False applied; `loop` repeats the
    recording. Raises InputError, which names the option, if a value is invalid.
    """
    overrides: tuple[tuple[str, str, dict[str, Any] | None], ...] = (
        ("--replay", "sensor", None if replay is None else {"driver": "replay", "source": replay}),
        ("--replay", "sensor", {"loop": True} if loop else None),
        ("--headless", "output", {"kind": "offscreen"} if headless else None),
        ("--scene", "content", None if scene is None else {"scene": scene}),
        ("--layout", "content", None if layout is None else {"layout": layout}),
        ("--model", "model", None if model is None else {"name": model}),
        ("--backend", "model", None if backend is None else {"backend": OLD_BACKENDS.get(backend, backend)}),
    )
    for option, section, values in overrides:
        if values is not None:
            settings = changed(settings, section, values, source=option)
    return settings


def changed(settings: Settings, section: str, values: dict[str, Any], *, source: str) -> Settings:
    """Return the settings with values in one section replaced. Raises InputError, which names `source`."""
    old: Section = getattr(settings, section)
    new = validated(type(old), old.model_dump() | values, source=source)
    return settings.model_copy(update={section: new})
