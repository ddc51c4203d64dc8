"""TOML and JSON files from outside, as tables."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

from runtime.errors import InputError
from runtime.support import untrusted_input

TABLE_BYTES_MAX = 4 << 20
KEY_PARTS_MAX = 16  # in a dotted key: tomllib's time and memory are quadratic in their number
STRINGS_AND_COMMENTS = re.compile(
    r'''"""(?:[^\\]|\\.)*?"""|\'{3}.*?\'{3}|"(?:[^"\\\n]|\\.)*"|'[^'\n]*'|#[^\n]*''', re.DOTALL
)
KEY_SEPARATORS = re.compile(r"[\n=,{}\[\]]")


def read_table(path: Path) -> dict[str, Any]:
    """Return the table in a TOML or JSON file. Raises InputError, naming the file and the line."""
    text = untrusted_input.read_text(path, most_bytes=TABLE_BYTES_MAX)
    table = untrusted_input.parsed_json(text, source=path) if path.suffix.lower() == ".json" else _toml(text, path)
    if not isinstance(table, dict):
        raise InputError(path, "", "must hold one table")
    return table


def _toml(text: str, path: Path) -> Any:
    keys = KEY_SEPARATORS.split(STRINGS_AND_COMMENTS.sub("_", text))
    if max(key.count(".") for key in keys) >= KEY_PARTS_MAX:
        raise InputError(path, "", f"malformed: a key of more than {KEY_PARTS_MAX} parts")
    try:
        return tomllib.loads(text)
    except ValueError as error:
        raise InputError(path, "", f"malformed: {error}") from None
    except RecursionError:
        raise InputError(path, "", "malformed: nested too deep") from None
