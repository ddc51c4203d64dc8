"""What a C library writes to stderr by itself, held back until it is known whether it belongs to an error."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass


@dataclass(slots=True)
class Held:
    """What was written, once the block is left."""

    text: str = ""

    @property
    def first_line(self) -> str:
        """Empty where there is none."""
        return next((line.strip() for line in self.text.splitlines() if line.strip()), "")

    def release(self) -> None:
        """Write it to stderr after all: no error tells it."""
        if self.text:
            with suppress(OSError):
                os.write(2, self.text.encode())


@contextmanager
def held_back() -> Iterator[Held]:
    """Hold back what this block's libraries write to the file descriptor of stderr.

    Only where this is the sole thread: the descriptor is the whole process's, and another's lines would be held too.
    """
    held = Held()
    if threading.active_count() > 1:
        yield held
        return
    try:
        kept = os.dup(2)
        buffer = os.memfd_create("stderr")
    except OSError:  # closed, or none left
        yield held
        return
    os.dup2(buffer, 2)
    try:
        yield held
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        data = os.pread(buffer, 1 << 16, 0)
        os.close(buffer)
        held.text = data.decode(errors="replace")
