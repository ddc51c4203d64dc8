"""Logging to a terminal or to journald.

Repeated messages are rate-limited, messages with line breaks cannot forge other log lines, and a slow reader of the log
never blocks the program.
"""

from __future__ import annotations

import copy
import logging
import os
import queue
import sys
import time
from collections.abc import Mapping
from contextlib import suppress
from datetime import datetime
from logging.handlers import QueueHandler, QueueListener
from typing import Any, TextIO

from runtime.clock import NS_PER_S, Clock, MonotonicClock
from runtime.errors import one_line
from runtime.support.crash import written

# Prefixes from sd-daemon(3) that set a line's priority in journald.
PRIORITY = {
    logging.DEBUG: "<7>",
    logging.INFO: "<6>",
    logging.WARNING: "<4>",
    logging.ERROR: "<3>",
    logging.CRITICAL: "<2>",
}
ROOTS = ("phasestack", "runtime")  # parents of the loggers named by subject and of those named by module
BURST = 5  # number of identical messages that pass within `QUIET_NS`
REMEMBERED = 1000  # maximum number of different messages to count
QUIET_NS = 30 * NS_PER_S  # a suppressed message passes again after this time
QUEUED_MAX = 4096  # maximum number of lines waiting for a reader
CLOSE_S = 1.0  # time limit for writing the last lines
LINE_MAX = 4000  # maximum number of characters in a line


class TextFormat(logging.Formatter):
    """Formatter that starts each line with time and level or, for journald, only a priority."""

    def __init__(self, *, journald: bool) -> None:
        super().__init__()
        self._journald = journald

    def format(self, record: logging.LogRecord) -> str:
        text = one_line(record.getMessage(), most=LINE_MAX)  # prevents forged lines
        if record.exc_info and record.exc_info[1]:
            text += f": {written(record.exc_info[1])}"  # the text names the file that contains the traceback
        if self._journald:
            return PRIORITY.get(record.levelno, "<6>") + text
        when = datetime.fromtimestamp(record.created).strftime("%H:%M:%S")
        return f"{when} {record.levelname.lower():7} {text}"


class RateLimit(logging.Filter):
    """Filter that passes at most five identical messages within 30 s. The next message that passes states
    how many were suppressed. Records with `extra={"always": True}`, such as changes of state, always pass.
    """

    def __init__(self, clock: Clock) -> None:
        super().__init__()
        self._clock = clock
        self._seen: dict[tuple[str, str], tuple[int, int, int]] = {}  # start of the window, messages passed, suppressed

    def filter(self, record: logging.LogRecord) -> bool:
        if getattr(record, "always", False):
            return True
        key = (record.name, str(record.msg))
        now_ns = self._clock.now_ns()
        if len(self._seen) > REMEMBERED:  # bound the memory for messages that never repeat
            self._seen.clear()
        start_ns, passed, suppressed = self._seen.get(key, (now_ns, 0, 0))
        if now_ns - start_ns >= QUIET_NS:
            start_ns, passed = now_ns, 0
        if passed >= BURST:
            self._seen[key] = (start_ns, passed, suppressed + 1)
            return False
        self._seen[key] = (start_ns, passed + 1, 0)
        if suppressed:
            record.msg, record.args = f"{record.getMessage()} ({suppressed} similar messages suppressed)", ()
        return True


class _Lines(logging.Handler):
    """Handler that writes lines to a file descriptor, on the listener's thread, because a slow reader blocks it."""

    def __init__(self, descriptor: int) -> None:
        super().__init__()
        self._descriptor = descriptor

    def createLock(self) -> None:
        """Create no lock, because only one thread writes, and the shutdown of logging must not block."""
        self.lock = None

    def emit(self, record: logging.LogRecord) -> None:
        with suppress(OSError):  # the reader has gone, or the disk is full
            os.write(self._descriptor, self.format(record).encode("utf-8", "backslashreplace") + b"\n")


class QueuedLines(QueueHandler):
    """Handler that writes lines on a separate thread. If too many lines are waiting, it drops new ones."""

    def __init__(self, descriptor: int, form: logging.Formatter) -> None:
        self.queue: queue.Queue[Any] = queue.Queue(QUEUED_MAX)
        super().__init__(self.queue)
        lines = _Lines(descriptor)
        lines.setFormatter(form)
        self._listener = QueueListener(self.queue, lines)
        self._listener.start()

    def prepare(self, record: logging.LogRecord) -> logging.LogRecord:
        """Format the message, but leave the exception to the listener's thread, because it takes longer."""
        prepared = copy.copy(record)
        prepared.msg, prepared.args = record.getMessage(), None
        return prepared

    def enqueue(self, record: logging.LogRecord) -> None:
        with suppress(queue.Full):
            self.queue.put_nowait(record)

    def flush(self) -> None:
        """Wait up to `CLOSE_S` seconds for the queued lines to be written."""
        deadline_s = time.monotonic() + CLOSE_S
        while self.queue.unfinished_tasks and time.monotonic() < deadline_s:
            time.sleep(0.005)

    def close(self) -> None:
        self.flush()
        if not self.queue.unfinished_tasks:  # otherwise the listener's thread is blocked, and ends with the process
            self._listener.stop()
        super().close()


def configure(
    *, stream: TextIO | None = None, clock: Clock | None = None, environment: Mapping[str, str] = os.environ
) -> None:
    """Set up logging, again if need be, to a stream, by default stderr, or to journald. `clock` is for
    the rate limit; `environment` determines whether the stream is journald's.
    """
    for old in logging.getLogger(ROOTS[0]).handlers[:]:
        if isinstance(old, QueuedLines):
            old.close()
    form = TextFormat(journald="JOURNAL_STREAM" in environment)
    handler = QueuedLines(os.dup((stream or sys.stderr).fileno()), form)  # a copy, in case the stream is closed
    handler.addFilter(RateLimit(clock or MonotonicClock()))
    for name in ROOTS:
        root = logging.getLogger(name)
        root.handlers[:] = [handler]
        root.setLevel(logging.INFO)
        root.propagate = False


def flush() -> None:
    """Wait up to `CLOSE_S` seconds for the queued lines to be written, before a process ends abruptly."""
    for handler in logging.getLogger(ROOTS[0]).handlers:
        handler.flush()
