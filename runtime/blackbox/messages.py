"""Each kind of message of a black box as JSON bytes, and the schemas by which other tools read them."""

from __future__ import annotations

import logging
from typing import Any

from runtime.clock import NS_PER_MS, NS_PER_S
from runtime.errors import one_line
from runtime.records import RefreshAccount
from runtime.sensor import recording_format as fmt
from runtime.support.artifacts import to_json

LOG, REFRESH, STATE = "/log", "/refresh", "/state"
FOXGLOVE_LEVELS = {logging.DEBUG: 1, logging.INFO: 2, logging.WARNING: 3, logging.ERROR: 4, logging.CRITICAL: 5}


def _schema(title: str, **types: Any) -> dict[str, Any]:
    return {"title": title, "type": "object", "properties": {name: {"type": kind} for name, kind in types.items()}}


_NUMBER, _LIST = ["number", "null"], ["array", "null"]
SCHEMAS: dict[str, dict[str, Any]] = {
    **fmt.SCHEMAS,
    LOG: _schema(
        "foxglove.Log", timestamp="object", level="integer", message="string", name="string", file="string",
        line="integer",
    ),
    REFRESH: _schema(
        "phasestack.Refresh", frame="integer", capture_ns="integer", predicted_for_ns="integer", present_ns="integer",
        photon_ns="integer", eyes_m=_LIST, eyes_label="string", eye_sigma_mm=_NUMBER, state="string",
        solution=["integer", "null"], solved_for_m=_LIST, solution_age_ms=_NUMBER, inference="string",
        presented="boolean", skew_ms="number", capture_to_light_ms=_NUMBER, stage_ms="object",
    ),
    STATE: _schema("phasestack.State", monotonic_ns="integer", state="string", missing="array", reason="string"),
}  # fmt: skip


def refresh(account: RefreshAccount) -> bytes:
    """A refresh, as `frames.jsonl` has it, and its latency."""
    known = account.eyes_m is not None and bool(account.capture_ns)
    return _packed(
        {
            "frame": account.frame,
            "capture_ns": account.capture_ns,
            "predicted_for_ns": account.predicted_for_ns,
            "present_ns": account.present_ns,
            "photon_ns": account.photon_ns,
            "eyes_m": _points(account.eyes_m),
            "eyes_label": account.eyes_label,
            "eye_sigma_mm": _rounded(account.eye_sigma_mm),
            "state": str(account.state),
            "solution": account.solution,
            "solved_for_m": _points(account.solved_for_m),
            "solution_age_ms": _rounded(account.solution_age_ms),
            "inference": account.inference,
            "presented": account.presented,
            "skew_ms": _rounded(account.skew_ms),
            "capture_to_light_ms": _rounded((account.photon_ns - account.capture_ns) / NS_PER_MS) if known else None,
            "stage_ms": {stage: _rounded(value) for stage, value in account.stage_ms.items()},
        }
    )


def _points(eyes_m: Any) -> Any:
    return None if eyes_m is None else [[round(x, 6) for x in eye] for eye in eyes_m.tolist()]


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 4)


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
            "level": FOXGLOVE_LEVELS.get(record.levelno, 2),
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
