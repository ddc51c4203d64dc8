"""What takes long to make and never changes is kept in the user's cache folder, named by what it follows from."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from pathlib import Path


def user_cache(name: str) -> Path:
    """The folder for what is kept of one kind, under $XDG_CACHE_HOME, else ~/.cache. It need not exist yet."""
    base = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(base) if Path(base).is_absolute() else Path.home() / ".cache") / "phasestack" / name


def digest(sources: Sequence[Path], *facts: object) -> str:
    """Twelve hex digits of these files' contents and facts: a folder of that name never outlives what made it."""
    total = hashlib.sha256(repr(facts).encode())
    for path in sources:
        total.update(path.read_bytes())
    return total.hexdigest()[:12]
