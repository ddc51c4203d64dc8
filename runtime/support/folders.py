"""Folders: for what is kept since it takes long to make, named by what it follows from; and for what outlives a run."""

from __future__ import annotations

import hashlib
import logging
import os
import stat
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path

log = logging.getLogger("phasestack.cache")

NOWHERE = Path(os.devnull) / "phasestack"  # a folder that is not there, nor can be made


def user_cache(name: str) -> Path:
    """The folder for what is kept of one kind. It need not exist yet."""
    return _root(os.environ.get("XDG_CACHE_HOME", "")) / name


@cache
def _root(base: str) -> Path:
    """Under $XDG_CACHE_HOME, else ~/.cache; where that is not this user's to write, their own in the
    temporary folder; `NOWHERE` where that is not theirs either."""
    own = NOWHERE
    with suppress(OSError, RuntimeError):  # a user whom the system does not know has no home
        own = (Path(base) if Path(base).is_absolute() else Path.home() / ".cache") / "phasestack"
        own.mkdir(mode=0o700, parents=True, exist_ok=True)
    if os.access(own, os.W_OK | os.X_OK) and _is_ours(own.stat(), others_may=0o055):
        return own
    other = Path(tempfile.gettempdir()) / f"phasestack-{os.geteuid()}"
    with suppress(OSError):
        other.mkdir(mode=0o700, exist_ok=True)
        if _is_ours(other.lstat(), others_may=0):
            log.warning("%s can't be written, or not by us alone: what takes long to make is kept in %s", own, other)
            return other
    return NOWHERE


def _is_ours(found: os.stat_result, *, others_may: int) -> bool:
    """Compiled code is loaded from a cache: what somebody else has put there is not ours."""
    return stat.S_ISDIR(found.st_mode) and found.st_uid == os.geteuid() and not found.st_mode & 0o077 & ~others_may


def digest(sources: Sequence[Path], *facts: object) -> str:
    """Twelve hex digits of these files' contents and facts: a folder of that name never outlives what made it."""
    total = hashlib.sha256(repr(facts).encode())
    for path in sources:
        total.update(path.read_bytes())
    return total.hexdigest()[:12]


def state_folder() -> Path:
    """The service's own state folder (systemd's), else the person's."""
    if given := os.environ.get("STATE_DIRECTORY", ""):
        return Path(given.split(":")[0])
    own, home = os.environ.get("XDG_STATE_HOME", ""), os.environ.get("HOME", "")
    if Path(own).is_absolute():
        return Path(own) / "phasestack"
    if home:
        return Path(home) / ".local" / "state" / "phasestack"
    return Path(tempfile.gettempdir()) / f"phasestack-state-{os.geteuid()}"
