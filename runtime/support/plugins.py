"""Plugins: users' Python classes, named `module:Class`, such as `mypackage.tunnel:Tunnel`."""

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
    """Return True if a name has the form `module:Class`."""
    return PLUGIN.fullmatch(name) is not None


def located(name: str, folder: Path) -> str:
    """Resolve a relative path against a folder; names, URLs and `module:Class` are returned unchanged."""
    if "://" in name or is_plugin(name):
        return name
    if not name or "\0" in name or not ("/" in name or Path(name).suffix):
        return name
    return str(folder / name)


def plugin_class(name: str, base: type, *, field: str) -> Any:
    """Import a plugin's class `module:Class`, derived from `base`, for a setting. Raises InputError if
    that fails, and MissingPart if an extra of phasestack is missing.
    """
    module, _, attribute = name.partition(":")
    try:
        plugin = getattr(importlib.import_module(module), attribute, None)
    except (Exception, SystemExit) as error:  # the module may raise any exception
        if missing := missing_extra(error):
            raise missing from None
        problem = one_line(f"{type(error).__name__}: {error}")
        raise InputError(
            field, "", f"`{module}` cannot be imported: {problem}; check that it is on PYTHONPATH"
        ) from error
    if not (isinstance(plugin, type) and issubclass(plugin, base)):
        package = "torch.nn" if base.__module__.startswith("torch.") else "phasestack"
        raise InputError(field, "", f"`{name}` is not a class derived from {package}.{base.__name__}")
    return plugin


def strict(options: type[BaseModel]) -> type[BaseModel]:
    """Return a variant of a plugin's options that rejects unknown keys, unless its class sets `extra`."""
    if "extra" in options.model_config:
        return options
    return type(options.__name__, (options,), {"__module__": __name__, "model_config": {"extra": "forbid"}})
