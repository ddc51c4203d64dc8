"""Files with their past versions beside them: `NAME.1.toml`, `NAME.2.toml`, ..."""

from __future__ import annotations

import re
from pathlib import Path

from runtime.support import untrusted_input
from runtime.support.artifacts import write_bytes, write_text

KEPT_VERSIONS = 20
KEPT_BYTES_MAX = 64 << 20


def save(path: Path, text: str) -> Path | None:
    """Write a file atomically; the one it replaces becomes the newest past version, which is returned."""
    kept = None
    if untrusted_input.is_there(path):
        pattern = re.compile(re.escape(path.stem) + r"\.(\d+)" + re.escape(path.suffix))
        matches = [pattern.fullmatch(file.name) for file in path.parent.iterdir()]
        past = sorted(int(match[1]) for match in matches if match)
        kept = _version(path, past[-1] + 1 if past else 1)
        write_bytes(kept, untrusted_input.read_bytes(path, most_bytes=KEPT_BYTES_MAX))
        for number in past[: max(0, len(past) + 1 - KEPT_VERSIONS)]:
            _version(path, number).unlink(missing_ok=True)
    write_text(path, text)
    return kept


def _version(path: Path, number: int) -> Path:
    return path.with_name(f"{path.stem}.{number}{path.suffix}")
