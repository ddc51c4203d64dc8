"""User-defined classes, named `module:Class`, as in `mypackage.tunnel:Tunnel`."""

from __future__ import annotations

import importlib
import re
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from runtime.errors import InputError, one_line
from runtime.support.extras import missing_extra

PLUGIN = re.compile(r"[A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*:[A-Za-z_]\w*", re.ASCII)


def is_plugin(name: str) -> bool:
    """True for `module:Class`."""
    return PLUGIN.fullmatch(name) is not None


def located(name: str, folder: Path) -> str:
    """A relative path resolved against a folder; a bare word without a suffix is a name and stays.

    What has a scheme (`rtsp://...`) is no path, nor is a class (`module:Class`).
    """
    if "://" in name or is_plugin(name):
        return name
    if not name or "\0" in name or not ("/" in name or Path(name).suffix):
        return name
    return str(folder / name)


def plugin_class(name: str, base: type, *, field: str) -> Any:
    """The class named `module:Class`. Raises InputError if missing, or not derived from `base`.

    field: the setting that names it.
    """
    module, _, attribute = name.partition(":")
    try:
        found = getattr(importlib.import_module(module), attribute, None)
    except (Exception, SystemExit) as error:  # whatever a module does when it is imported
        if missing := missing_extra(error):
            raise missing from None
        problem = one_line(f"{type(error).__name__}: {error}")
        raise InputError(field, "", f"`{module}` cannot be imported from Python's path ({problem})") from error
    if not (isinstance(found, type) and issubclass(found, base)):
        of = "torch.nn" if base.__module__.startswith("torch.") else "phasestack"
        raise InputError(field, "", f"`{name}` is no class that derives from {of}.{base.__name__}")
    return found


def strict(options: type[BaseModel]) -> type[BaseModel]:
    """A class's options with unknown keys refused, unless the class itself allows them."""
    if "extra" in options.model_config:
        return options
    return type(options.__name__, (options,), {"__module__": __name__, "model_config": {"extra": "forbid"}})
