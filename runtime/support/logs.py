"""Log lines for people, for journald and for machines.

A fault that repeats does not flood them, a message can't forge a line, and who logs never waits for who reads.
"""

from __future__ import annotations

import json
import logging
import os
import sys
from collections.abc import Mapping
from datetime import UTC, datetime
from io import UnsupportedOperation
from typing import Any, TextIO

from runtime.clock import NS_PER_S, Clock, MonotonicClock
from runtime.config import ServiceSettings
from runtime.errors import one_line
from runtime.support.crash import written
from runtime.support.log_writer import LogWriter

# What sd-daemon(3) puts before a line so that journald files it under its level.
PRIORITY = {
    logging.DEBUG: "<7>",
    logging.INFO: "<6>",
    logging.WARNING: "<4>",
    logging.ERROR: "<3>",
    logging.CRITICAL: "<2>",
}
ROOTS = ("phasestack", "runtime")  # named for what they tell, or after their module
BURST = 5
REMEMBERED = 1000
QUIET_NS = 30 * NS_PER_S
CLOSE_S = 1.0  # so long the last lines are waited for
LINE_MAX = 4000  # characters


class TextFormat(logging.Formatter):
    """The message; under journald with a priority and no time (it has its own), else with the time."""

    def __init__(self, *, journald: bool) -> None:
        super().__init__()
        self._journald = journald

    def format(self, record: logging.LogRecord) -> str:
        text = one_line(record.getMessage(), most=LINE_MAX)  # nobody's name or message forges a line
        if record.exc_info and record.exc_info[1]:
            text += f": {written(record.exc_info[1])}"  # a traceback is for whoever mends it, not for the log
        if self._journald:
            prefix = PRIORITY.get(record.levelno, "<6>")
            return prefix + text
        when = datetime.fromtimestamp(record.created).strftime("%H:%M:%S")
        return f"{when} {record.levelname.lower():7} {text}"


class JsonFormat(logging.Formatter):
    """One JSON object a line: time, level, logger, message."""

    def format(self, record: logging.LogRecord) -> str:
        line: dict[str, Any] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        if record.exc_info and record.exc_info[1]:
            line["exception"] = written(record.exc_info[1])
        return json.dumps(line, default=str)


class RateLimit(logging.Filter):
    """Lets five lines of one message through in any half minute; the next that passes says how many did not.

    A record with `extra={"always": True}` (a transition of state) always passes.
    """

    def __init__(self, clock: Clock) -> None:
        super().__init__()
        self._clock = clock
        self._seen: dict[tuple[str, str], tuple[int, int, int]] = {}  # start of the window, passed, suppressed

    def filter(self, record: logging.LogRecord) -> bool:
        if getattr(record, "always", False):
            return True
        key = (record.name, str(record.msg))
        now_ns = self._clock.now_ns()
        if len(self._seen) > REMEMBERED:  # messages that are never twice the same must not pile up
            self._seen.clear()
        start_ns, passed, suppressed = self._seen.get(key, (now_ns, 0, 0))
        if now_ns - start_ns >= QUIET_NS:
            start_ns, passed = now_ns, 0
        if passed >= BURST:
            self._seen[key] = (start_ns, passed, suppressed + 1)
            return False
        self._seen[key] = (start_ns, passed + 1, 0)
        if suppressed:
            record.msg, record.args = f"{record.getMessage()} ({suppressed} more like this were not shown)", ()
        return True


class Handler(logging.Handler):
    """Formats where it is logged; a thread of its own writes."""

    def __init__(self, stream: TextIO) -> None:
        super().__init__()
        self._memory: TextIO | None = None
        self._writer: LogWriter | None = None
        try:
            descriptor = stream.fileno()
        except (UnsupportedOperation, AttributeError):
            self._memory = stream  # in memory: writing never waits
            return
        except ValueError:  # closed
            descriptor = -1
        self._writer = LogWriter(descriptor, told=self._told)

    @property
    def lost(self) -> int:
        """Lines that could not be written."""
        return self._writer.lost if self._writer is not None else 0

    def emit(self, record: logging.LogRecord) -> None:
        if self._memory is not None:
            self._memory.write(self._line(record).decode())
        elif self._writer is not None and record.exc_info:
            # An exception is written down whole in a file: not by whom it befell, whose time it would be.
            self._writer.put(lambda: self._line(record))
        elif self._writer is not None:
            self._writer.put(self._line(record))

    def _line(self, record: logging.LogRecord) -> bytes:
        try:
            line = self.format(record)
        except Exception as error:
            line = self.format(_record(logging.ERROR, f"a log line could not be made: {record.msg!r} ({error})"))
        return line.encode("utf-8", "backslashreplace") + b"\n"

    def flush(self) -> None:
        """Wait a moment for what is not written yet."""
        if self._writer is not None:
            self._writer.flush(CLOSE_S)

    def close(self) -> None:
        if self._writer is not None:
            self._writer.close(CLOSE_S)
        super().close()

    def _told(self, count: int) -> bytes:
        return self._line(_record(logging.WARNING, f"{count} log lines were lost: they could not be written"))


def _record(level: int, message: str) -> logging.LogRecord:
    return logging.LogRecord("phasestack.log", level, "", 0, message, (), None)


def configure(
    settings: ServiceSettings,
    *,
    stream: TextIO | None = None,
    clock: Clock | None = None,
    environment: Mapping[str, str] = os.environ,
) -> None:
    """Send every log line of ours to a stream (stderr), in the configured form. Calling it again replaces."""
    for old in _handlers():
        old.close()
    handler = Handler(stream or sys.stderr)
    journald = "JOURNAL_STREAM" in environment
    handler.setFormatter(JsonFormat() if settings.log_format == "json" else TextFormat(journald=journald))
    handler.addFilter(RateLimit(clock or MonotonicClock()))
    for name in ROOTS:
        root = logging.getLogger(name)
        root.handlers[:] = [handler]
        root.setLevel(settings.log_level.upper())
        root.propagate = False


def lost() -> int:
    """Lines that could not be written since the logs were configured."""
    return sum(handler.lost for handler in _handlers())


def flush() -> None:
    """Wait a moment for what is not written yet: before the process ends without Python's own clean-up."""
    for handler in _handlers():
        handler.flush()


def _handlers() -> list[Handler]:
    return [handler for handler in logging.getLogger(ROOTS[0]).handlers if isinstance(handler, Handler)]
