"""What a worker, a driver or a scene does to its own process in a test, by name."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from collections.abc import Callable


def _loop() -> None:
    while True:
        pass


DEEDS: dict[str, Callable[[], object]] = {
    "crash": lambda: ctypes.string_at(0),
    "die": lambda: os.kill(os.getpid(), signal.SIGKILL),
    "stop": lambda: os.kill(os.getpid(), signal.SIGSTOP),
    "loop": _loop,
    "sleep": lambda: ctypes.CDLL(None).sleep(3600),
    "exit": lambda: sys.exit("no licence"),
}
