"""Helpers that wait for what another thread or process does."""

from __future__ import annotations

import time
from collections.abc import Callable

# `phasestack` in a separate process, whose solver is never late, even on a busy machine.
PATIENT = "from runtime.cli import main; from runtime.frame import solver_process; solver_process.LATE_S = 60.0; main()"


def eventually(holds: Callable[[], bool], *, within_s: float = 60.0) -> bool:
    """True as soon as it holds; False if it doesn't in all that time."""
    deadline = time.monotonic() + within_s
    while not holds():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.005)
    return True
