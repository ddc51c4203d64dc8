"""Types for settings that contain a path, which is relative to the folder of the configuration file.

Paths from code or the command line are not changed.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator

from runtime.support.plugins import located


def path_in(folder: Path | None, value: str, *, or_name: bool = False) -> str:
    """Return a path resolved against the folder of the configuration file.

    Args:
        folder: Folder of the configuration file. None: return the value unchanged.
        value: Path.
        or_name: Return a single word without a suffix unchanged, because such a word is a name.
    """
    if folder is None or Path(value).name in ("", ".."):
        return value
    return located(value, folder) if or_name else str(folder / value)


PathText = Annotated[str, AfterValidator(lambda value, info: path_in(info.context, value))]
# For example, `demo` is a name, and `demo.glb` is a path.
NameOrPath = Annotated[str, AfterValidator(lambda value, info: path_in(info.context, value, or_name=True))]
