"""Each kind of message of a black box as JSON bytes, and the schemas by which other tools read them."""

from __future__ import annotations

import logging
from typing import Any

from runtime.clock import NS_PER_MS, NS_PER_S
from runtime.errors import one_line
from runtime.frame.observer import line_of
from runtime.records import RefreshAccount
from runtime.sensor import recording_format as fmt
from runtime.support.artifacts import to_json

LOG, REFRESH, STATE = "/log", "/refresh", "/state"
# Viewers plot a number wherever it stands; only what they show in a way of its own needs its fields named.
SCHEMAS: dict[str, dict[str, Any]] = {
    **fmt.SCHEMAS,
    LOG: {
        "title": "foxglove.Log",
        "type": "object",
        "properties": {
            "timestamp": {"type": "object"},
            "level": {"type": "integer"},
            "message": {"type": "string"},
            "name": {"type": "string"},
            "file": {"type": "string"},
            "line": {"type": "integer"},
        },
    },
    REFRESH: {"title": "phasestack.Refresh", "type": "object"},
    STATE: {"title": "phasestack.State", "type": "object"},
}


def refresh(account: RefreshAccount) -> bytes:
    """A refresh, as `frames.jsonl` has it, and its latency."""
    latency_ms = None
    if account.eyes_m is not None and account.capture_ns:
        latency_ms = round((account.photon_ns - account.capture_ns) / NS_PER_MS, 4)
    return _packed(line_of(account) | {"photon_ns": account.photon_ns, "capture_to_light_ms": latency_ms})


def state(name: str, reason: str, *, monotonic_ns: int) -> bytes:
    """A state as people read it (`degraded: sensor, panel`), taken apart."""
    plain, _, missing = name.partition(": ")
    parts = missing.split(", ") if missing else []
    return _packed({"monotonic_ns": monotonic_ns, "state": plain, "missing": parts, "reason": reason})


def log(record: logging.LogRecord) -> bytes:
    """A log line."""
    seconds, nanoseconds = divmod(round(record.created * NS_PER_S), NS_PER_S)
    return _packed(
        {
            "timestamp": {"sec": seconds, "nsec": nanoseconds},
            "level": record.levelno // 10,  # Foxglove's levels are Python's by ten
            "message": text_of(record),
            "name": record.name,
            "file": record.filename,
            "line": record.lineno,
        }
    )


def text_of(record: logging.LogRecord) -> str:
    """A log record's message on one line, with the exception that it is about."""
    text = record.getMessage()
    if record.exc_info and record.exc_info[1] is not None:
        text += f": {type(record.exc_info[1]).__name__}: {record.exc_info[1]}"
    return one_line(text)


def _packed(value: Any) -> bytes:
    return to_json(value).encode()
