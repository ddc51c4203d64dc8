"""Kernels compiled by numba. The first import of one on a machine compiles it, which takes seconds and is kept."""

from __future__ import annotations

import logging
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from hashlib import sha256
from importlib import metadata, resources
from io import BytesIO
from pathlib import Path
from typing import Any

# Before its import. The highest level compiles a fifth longer, and nothing runs faster by it.
os.environ.setdefault("NUMBA_OPT", "2")
import numba
from numba.core import caching

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
    log.warning("compiled kernels can't be kept: every start compiles them anew")
    return None


KEPT_IN = _kept()
numba.config.CACHE_DIR = str(KEPT_IN or "")  # type: ignore[attr-defined]


class CheckedFiles(caching.IndexDataCacheFile):
    """numba's two files of a function, each with what its bytes come to at its end.

    Files that a power cut left short, or that a disk returned otherwise, are no answer to unpickle, nor code to run:
    they are deleted, one line tells it, and the function is compiled anew.
    """

    def _load_index(self) -> Any:
        return self._checked(Path(self._index_path), super()._load_index) or {}

    def _load_data(self, name: str) -> Any:
        loaded = self._checked(Path(self._data_path(name)), lambda: super(CheckedFiles, self)._load_data(name))
        if loaded is None:
            raise FileNotFoundError(name)  # numba compiles it then
        return loaded

    def _checked(self, path: Path, load: Callable[[], Any]) -> Any:
        """None: there is none, or it was deleted."""
        try:
            data = path.read_bytes()
            if sha256(data[:-32]).digest() == data[-32:]:
                return load()
            problem = f"{len(data)} bytes that are not those that were written"
        except FileNotFoundError:
            return None
        except Exception as error:  # whatever unpickling raises
            problem = f"{type(error).__name__}: {error}"
        log.warning("compiled kernels: %s can't be used (%s): it is compiled anew", path, problem)
        with suppress(OSError):
            path.unlink()
        return None

    @contextmanager
    def _open_for_write(self, filepath: str) -> Iterator[BytesIO]:
        with super()._open_for_write(filepath) as file:
            written = BytesIO()
            yield written
            file.write(written.getvalue() + sha256(written.getvalue()).digest())


caching.IndexDataCacheFile = CheckedFiles  # type: ignore[misc]
