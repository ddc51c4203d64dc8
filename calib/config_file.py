"""Edit configuration files. Comments and old versions are kept, and only valid files are written."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tomlkit
from tomlkit.exceptions import ParseError

from runtime.config import load_settings
from runtime.errors import InputError
from runtime.support import untrusted_input
from runtime.support.artifacts import write_bytes, write_text

if TYPE_CHECKING:
    from tomlkit import TOMLDocument


KEPT_VERSIONS = 20  # number of old versions kept per file
KEPT_BYTES_MAX = 64 << 20  # size limit for a file that is backed up


def save(path: Path, text: str) -> Path | None:
    """Write a file, or a symbolic link's target, atomically, and keep the version that it replaces.
    Return the numbered path of the old version, with the same permissions, or None if the file is new.
    """
    path, kept = path.resolve(), None
    if untrusted_input.is_there(path):
        pattern = re.compile(re.escape(path.stem) + r"\.(\d+)" + re.escape(path.suffix))
        matches = [pattern.fullmatch(file.name) for file in path.parent.iterdir()]
        past = sorted(int(match[1]) for match in matches if match)
        kept = _version(path, past[-1] + 1 if past else 1)
        write_bytes(kept, untrusted_input.read_bytes(path, most_bytes=KEPT_BYTES_MAX), like=path)
        for number in past[: max(0, len(past) + 1 - KEPT_VERSIONS)]:
            _version(path, number).unlink(missing_ok=True)
    write_text(path, text)
    return kept


def _version(path: Path, number: int) -> Path:
    return path.with_name(f"{path.stem}.{number}{path.suffix}")


def read_document(config: Path) -> TOMLDocument:
    """Read a configuration, empty if the file does not exist. Raises InputError if it is invalid."""
    if not untrusted_input.is_there(config):
        return tomlkit.document()
    load_settings(config)
    try:
        return tomlkit.parse(untrusted_input.read_text(config))
    except ParseError as error:
        raise InputError(config, "", f"malformed: {error}") from None


def rewrite(config: Path, change: Callable[[TOMLDocument], None]) -> Path | None:
    """Change a configuration's document in place, and return the old version's path, or None for a new
    file. If the result is invalid, InputError is raised and the file stays unchanged.
    """
    document = read_document(config)
    change(document)
    text = tomlkit.dumps(document)
    with tempfile.TemporaryDirectory() as folder:
        trial = Path(folder) / config.name
        write_text(trial, text)
        load_settings(trial)
    return save(config, text)


def put(document: TOMLDocument, section: str, values: Mapping[str, Any]) -> None:
    """Set keys in a section's table. The table is created if the document has no such section."""
    document.setdefault(section, tomlkit.table()).update(values)


def put_panels(document: TOMLDocument, key: str, values: Mapping[int, Any], *, panels: int) -> None:
    """Set a key, such as `lut`, in `[[output.panels]]` by panel index. Missing tables are created."""
    output: Any = document.setdefault("output", tomlkit.table())
    if "panels" not in output:
        output["panels"] = tomlkit.aot()
        for _ in range(panels):
            output["panels"].append(tomlkit.table())
    for index, value in values.items():
        output["panels"][index][key] = value


def put_monitors(document: TOMLDocument, tables: Sequence[Mapping[str, Any]]) -> None:
    """Set every panel's monitor and mounting, rear to front. A panel whose monitor and mounting have not
    changed keeps its registration and its grey curve.
    """
    output: Any = document.setdefault("output", tomlkit.table())
    past = [dict(table.unwrap()) for table in output.get("panels", ())]
    panels = tomlkit.aot()
    for values in tables:
        same = next((old for old in past if all(old.get(k, _DEFAULTS.get(k)) == v for k, v in values.items())), {})
        table = tomlkit.table()
        table.update({**same, **values})
        panels.append(table)
    if "panels" in output:
        del output["panels"]
    output["panels"] = panels
    if output.get("kind", "offscreen") == "offscreen":
        output["kind"] = "windows"


_DEFAULTS: dict[str, Any] = {"rotation_deg": 0, "mirror": "none"}
