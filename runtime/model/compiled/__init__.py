"""Kernels compiled by numba. The first import of one on a machine compiles it, which takes seconds and is kept."""

from __future__ import annotations

import logging
import os
import shutil
from contextlib import suppress
from importlib import metadata, resources
from pathlib import Path

# Before its import. The highest level compiles a fifth longer, and nothing runs faster by it.
os.environ.setdefault("NUMBA_OPT", "2")
import numba

from runtime.support.folders import digest, user_cache

log = logging.getLogger("phasestack.model")
ROOM = 32 << 20  # bytes free, where compiled code is kept: it takes three MiB


def _kept() -> Path | None:
    """The folder for compiled code, named by what it follows from; None where none can be written."""
    sources = sorted(Path(str(resources.files("runtime.model") / "compiled")).glob("*.py"))
    folder = user_cache("compiled") / digest(sources, metadata.version("numba"))
    with suppress(OSError):
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if os.access(folder, os.W_OK) and shutil.disk_usage(folder).free > ROOM:
            return folder
    log.warning("compiled kernels can't be kept in %s: every start compiles them anew", folder)
    return None


KEPT_IN = _kept()
numba.config.CACHE_DIR = str(KEPT_IN or "")  # type: ignore[attr-defined]
