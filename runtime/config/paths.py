"""Types of settings that name a file: paths are relative to the folder of the file that holds them.

Where settings are validated without that folder (from code or the command line), they stay as they are.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator

from runtime.support.plugins import located


def path_in(folder: Path | None, value: str, *, or_name: bool = False) -> str:
    """Return the path resolved against the folder.

    or_name: a bare word without a suffix is a name and stays.
    """
    if folder is None or Path(value).name in ("", ".."):
        return value
    return located(value, folder) if or_name else str(folder / value)


PathText = Annotated[str, AfterValidator(lambda value, info: path_in(info.context, value))]
# `demo` is a name, `demo.glb` a path.
NameOrPath = Annotated[str, AfterValidator(lambda value, info: path_in(info.context, value, or_name=True))]
