"""Classes of a user's own, named by a dotted path: `mypackage.tunnel:Tunnel` is the class `Tunnel` of that module."""

from __future__ import annotations

import importlib
import re
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from runtime.errors import InputError, one_line

PLUGIN = re.compile(r"[A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*:[A-Za-z_]\w*", re.ASCII)


def is_plugin(name: str) -> bool:
    """True for `module:Class`."""
    return PLUGIN.fullmatch(name) is not None


def located(name: str, folder: Path) -> str:
    """A name as it is; a path that is relative, seen from a folder. A bare word without a suffix is a name.

    What has a scheme (`rtsp://...`) is no path, nor is a class (`module:Class`).
    """
    if "://" in name or is_plugin(name):
        return name
    if not name or "\0" in name or not ("/" in name or Path(name).suffix):
        return name
    return str(folder / name)


def plugin_class(name: str, base: type, *, field: str) -> Any:
    """The class that `name` stands for. Raises InputError: no such module or class, or one that is no `base`.

    field: the setting that names it.
    """
    module, _, attribute = name.partition(":")
    try:
        found = getattr(importlib.import_module(module), attribute, None)
    except (Exception, SystemExit) as error:  # whatever a module does when it is imported
        problem = one_line(f"{type(error).__name__}: {error}")
        raise InputError(field, "", f"`{module}` cannot be imported from Python's path ({problem})") from error
    if not (isinstance(found, type) and issubclass(found, base)):
        of = "torch.nn" if base.__module__.startswith("torch.") else "phasestack"
        raise InputError(field, "", f"`{name}` is no class that derives from {of}.{base.__name__}")
    return found


def strict(options: type[BaseModel]) -> type[BaseModel]:
    """A class's options, where a mistyped key is refused, unless the class itself says what becomes of such."""
    if "extra" in options.model_config:
        return options
    return type(options.__name__, (options,), {"__module__": __name__, "model_config": {"extra": "forbid"}})
