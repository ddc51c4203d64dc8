"""Types for settings that contain a path relative to the configuration file's folder.

A path given in code or on the command line is used unchanged.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator

from runtime.support.plugins import located


def path_in(folder: Path | None, value: str, *, or_name: bool = False) -> str:
    """Return a path resolved against the configuration file's folder, if any; with `or_name`, a word
    without suffix stays. `~` is the user's home folder, as in a shell.
    """
    if folder is not None and value.startswith("~/"):
        try:
            return str(Path(value).expanduser())
        except RuntimeError:
            raise ValueError("the home folder is not known") from None
    if folder is None or Path(value).name in ("", ".."):
        return value
    return located(value, folder) if or_name else str(folder / value)


PathText = Annotated[str, AfterValidator(lambda value, info: path_in(info.context, value))]
# For example, `demo` is a name but `demo.glb` is a path.
NameOrPath = Annotated[str, AfterValidator(lambda value, info: path_in(info.context, value, or_name=True))]
