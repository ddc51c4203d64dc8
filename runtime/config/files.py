"""Configuration and panels files."""

from __future__ import annotations

from pathlib import Path

from runtime.config.settings import PANELS_MOST, Settings, StackGeometry
from runtime.errors import InputError
from runtime.optics.stack import PanelStack
from runtime.support.sections import validated
from runtime.support.tables import read_table


def load_settings(path: Path | None) -> Settings:
    """Return the settings in a file, or the defaults without one. Raises InputError."""
    if path is None:
        return Settings()
    return validated(Settings, read_table(path), source=path, folder=path.absolute().parent)


def load_stack(path: Path, *, width_px: int, height_px: int) -> PanelStack:
    """Return the geometry in `--panels FILE`, with the images' size as default. Raises InputError."""
    table = {"width_px": width_px, "height_px": height_px} | read_table(path)
    for name in ("width_m", "height_m", "x_m"):
        if name not in table:
            hint = ": a configuration has it under [stack], a panels file at the top" if "stack" in table else ""
            raise InputError(path, name, f"is missing{hint}")
    if not 2 <= len(table["x_m"] if isinstance(table["x_m"], list) else ()) <= PANELS_MOST:
        raise InputError(path, "x_m", f"must list 2 to {PANELS_MOST} panels")
    return validated(StackGeometry, table, source=path).stack()
