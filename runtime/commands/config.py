"""`phasestack config`: every setting with its default and meaning."""

from __future__ import annotations

import json
from typing import Any


def config() -> None:
    """Print a complete configuration: every setting, its default and what it means. It is valid TOML.

    Paths in a configuration are relative to its folder. `phasestack doctor --config FILE` checks one.

    Example: phasestack config > phasestack.toml
    """
    from runtime.config import Settings

    print("# Paths are relative to this file's folder.")
    print("\n".join(_lines(Settings, Settings(), "")))


def _lines(model: Any, values: Any, prefix: str) -> list[str]:
    """TOML with a comment above each key."""
    from pydantic import BaseModel

    plain: list[str] = []
    tables: list[str] = []
    for name, info in model.model_fields.items():
        value = getattr(values, name)
        if isinstance(value, BaseModel):
            title = f"{prefix}{name}"
            tables += ["", f"# {info.description or ''}", f"[{title}]", *_lines(type(value), value, f"{title}.")]
            continue
        plain.append(f"# {info.description or ''}")
        text = _toml(value)
        plain.append(f"# {name} =" if text is None else f"{name} = {text}")
    return plain + tables


def _toml(value: Any) -> str | None:
    if value is None:
        return None
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_toml(item)}" for key, item in value.items()) + " }"
    if isinstance(value, tuple | list):
        return "[" + ", ".join(str(_toml(item)) for item in value) + "]"
    return json.dumps(value)
