"""Start child processes, end them with their parent, and pass on limits, log lines and shortages."""

from __future__ import annotations

import ctypes
import logging
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from runtime.errors import PASSING
from runtime.support.channel import ChannelClosed
from runtime.support.crash import written
from runtime.support.untrusted_input import LIMITS

PR_SET_PDEATHSIG = 1  # constant from Linux's prctl.h


def started(
    module: str, argument: str, *, files: Sequence[int], output: int, **variables: str
) -> subprocess.Popen[bytes]:
    """Start a module of this copy of phasestack, with inherited file descriptors. Raises OSError."""
    path = os.pathsep.join([str(Path(__file__).parents[2]), *filter(None, sys.path)])
    return subprocess.Popen(
        [sys.executable, "-P", "-m", module, argument],
        stdin=subprocess.DEVNULL,
        stdout=output,
        stderr=output,
        pass_fds=files,
        env=os.environ | {"PYTHONPATH": path} | variables,
    )


def end_with_parent() -> None:
    """Have the kernel end this process when the thread that started it ends."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


def take_over(limits: Mapping[str, Any], send: Callable[[dict[str, Any]], object]) -> None:
    """Use the parent's limits for untrusted files, and pass log records to `send` (`log_forwarded`)."""
    for name, limit in limits.items():
        setattr(LIMITS, name, limit)
    logging.getLogger().addHandler(_Forwarded(send))
    logging.getLogger().setLevel(logging.INFO)


class _Forwarded(logging.Handler):
    def __init__(self, send: Callable[[dict[str, Any]], object]) -> None:
        super().__init__()
        self._send = send

    def emit(self, record: logging.LogRecord) -> None:
        text = record.getMessage()
        if record.exc_info and record.exc_info[1]:
            text += f": {written(record.exc_info[1])}"
        content = {"name": record.name, "levelno": record.levelno, "levelname": record.levelname, "msg": text}
        with suppress(ChannelClosed):
            self._send(content | {"always": getattr(record, "always", False)})


def log_forwarded(content: dict[str, Any]) -> None:
    """Log a record that another process has passed on."""
    logger = logging.getLogger(content["name"])
    if logger.isEnabledFor(content["levelno"]):
        logger.handle(logging.makeLogRecord(content))


def passing_cause(error: BaseException | None) -> OSError | MemoryError | None:
    """Return the shortage that has caused an error, without its trace, or None if it has another cause."""
    while error is not None:
        if isinstance(error, MemoryError):
            return MemoryError()
        if isinstance(error, OSError) and error.errno in PASSING:
            return OSError(error.errno, error.strerror)
        error = error.__cause__ or error.__context__
    return None
