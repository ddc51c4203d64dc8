"""Parts of a long measurement, each kept as soon as it is there: one that was stopped goes on from where it was.

They are pickles in the user's own cache folder, which nobody else may write to, under a name made of all that they
follow from: other code, options, files or another machine never find them.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import re
import shutil
import stat
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import runtime
from runtime.report.machine import describe
from runtime.support.artifacts import write_bytes
from runtime.support.cache import digest, user_cache

T = TypeVar("T")


class KeptParts:
    """The parts of one measurement."""

    def __init__(self, name: str, *, sources: Sequence[Path], facts: object, fresh: bool = False) -> None:
        """sources: files that it follows from, beside our code; fresh: forget what an earlier run has left."""
        code = sorted(Path(runtime.__file__).parent.rglob("*.py"))
        machine = {key: value for key, value in describe().items() if key != "date"}
        self._folder = user_cache(name) / digest([*code, *sources], facts, sorted(machine.items()))
        self.earlier: list[str] = []  # names of those that an earlier run had measured
        if fresh:
            self.forget()

    def part(self, name: str, make: Callable[[], T]) -> T:
        """The part of that name: as an earlier run left it, or made now and kept."""
        # The digest tells names apart that are alike but for what a file's name can't hold.
        readable = re.sub(r"[^A-Za-z0-9.-]+", "-", name)[:80]
        path = self._folder / f"{readable}-{digest([], name)}.pickle"
        with contextlib.suppress(OSError, EOFError, pickle.UnpicklingError, AttributeError, ImportError):
            if self._is_ours():
                found: T = pickle.loads(path.read_bytes())
                self.earlier.append(name)
                return found
        made = make()
        # A full disk, or a part that can't be kept, costs what was kept, not what is measured.
        with contextlib.suppress(OSError, pickle.PicklingError, TypeError, AttributeError):
            self._folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            self._folder.chmod(0o700)
            write_bytes(path, pickle.dumps(made))
        return made

    def of(self, group: str) -> Callable[[str, Callable[[], Any]], Any]:
        """`part` of one group of parts."""
        return lambda name, make: self.part(f"{group} {name}", make)

    def forget(self) -> None:
        """It is complete, or no longer wanted."""
        shutil.rmtree(self._folder, ignore_errors=True)

    def _is_ours(self) -> bool:
        found = self._folder.lstat()
        return stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022


def measured_anew(name: str, make: Callable[[], T]) -> T:
    """Keeps nothing."""
    return make()
