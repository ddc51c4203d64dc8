"""What a C library writes to stderr by itself, held back: it belongs into the one line of an error, or to nobody."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass


@dataclass(slots=True)
class Held:
    """What was written, once the block is left."""

    text: str = ""

    @property
    def first_line(self) -> str:
        """Empty where there is none."""
        return next((line.strip() for line in self.text.splitlines() if line.strip()), "")


@contextmanager
def held_back() -> Iterator[Held]:
    """Hold back what this block's libraries write to the file descriptor of stderr.

    Only where this is the sole thread: the descriptor is the whole process's, and another's lines would be held too.
    """
    held = Held()
    if threading.active_count() > 1:
        yield held
        return
    kept = os.dup(2)
    buffer = os.memfd_create("stderr")
    os.dup2(buffer, 2)
    try:
        yield held
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        data = os.pread(buffer, 1 << 16, 0)
        os.close(buffer)
        held.text = data.decode(errors="replace")
