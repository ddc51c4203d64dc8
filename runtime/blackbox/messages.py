"""Each kind of message of a black box as JSON bytes: pure functions of what happened."""

from __future__ import annotations

import base64
import json
from dataclasses import dataclass
from typing import Any

from runtime.clock import NS_PER_MS, NS_PER_S
from runtime.records import RefreshAccount

LEVELS = ((50, 5), (40, 4), (30, 3), (20, 2), (10, 1))  # logging's, foxglove.Log's


@dataclass(frozen=True, slots=True)
class Message:
    """One message, ready to be written."""

    topic: str
    wall_ns: int  # since 1970
    data: bytes  # JSON
    sequence: int = 0


def packed(value: Any) -> bytes:
    """JSON, as short as it is."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False).encode()


def stamp(wall_ns: int) -> dict[str, int]:
    """A time as Foxglove's schemas have it."""
    seconds, nanoseconds = divmod(wall_ns, NS_PER_S)
    return {"sec": seconds, "nsec": nanoseconds}


def refresh(account: RefreshAccount) -> bytes:
    """A refresh, as `frames.jsonl` tells it, with the covariance and the latency that plots want."""
    known = account.eyes_m is not None and bool(account.capture_ns)
    sigma_mm = account.eye_sigma_mm
    variance_m2 = None if sigma_mm is None else (sigma_mm / 1e3) ** 2
    return packed(
        {
            "frame": account.frame,
            "capture_ns": account.capture_ns,
            "predicted_for_ns": account.predicted_for_ns,
            "present_ns": account.present_ns,
            "photon_ns": account.photon_ns,
            "eyes_m": _eyes(account.eyes_m),
            "eyes_label": account.eyes_label,
            "eye_sigma_mm": None if sigma_mm is None else round(sigma_mm, 4),
            "eye_covariance_m2": None if variance_m2 is None else [variance_m2 * (i % 4 == 0) for i in range(9)],
            "state": str(account.state),
            "solution": account.solution,
            "solved_for_m": _eyes(account.solved_for_m),
            "solution_age_ms": None if account.solution_age_ms is None else round(account.solution_age_ms, 4),
            "inference": account.inference,
            "presented": account.presented,
            "skew_ms": round(account.skew_ms, 4),
            "capture_to_light_ms": round((account.photon_ns - account.capture_ns) / NS_PER_MS, 4) if known else None,
            "stage_ms": {stage: round(value, 4) for stage, value in account.stage_ms.items()},
        }
    )


def _eyes(eyes_m: Any) -> Any:
    return None if eyes_m is None else [[round(x, 6) for x in eye] for eye in eyes_m.tolist()]


def state(name: str, reason: str, *, monotonic_ns: int) -> bytes:
    """A state as people read it (`degraded: sensor, panel`), taken apart."""
    plain, _, missing = name.partition(": ")
    parts = missing.split(", ") if missing else []
    return packed({"monotonic_ns": monotonic_ns, "state": plain, "missing": parts, "reason": reason})


def clock(*, monotonic_ns: int, wall_ns: int, lost: int) -> bytes:
    """Both clocks."""
    return packed({"monotonic_ns": monotonic_ns, "wall_ns": wall_ns, "lost": lost})


def log(level: int, name: str, text: str, *, file: str, line: int, wall_ns: int) -> bytes:
    """A log line; level: logging's."""
    told = next((theirs for ours, theirs in LEVELS if level >= ours), 0)
    return packed(
        {"timestamp": stamp(wall_ns), "level": told, "message": text, "name": name, "file": file, "line": line}
    )


def picture(jpeg: bytes, *, frame_id: str, wall_ns: int) -> bytes:
    """A JPEG."""
    data = base64.b64encode(jpeg).decode()
    return packed({"timestamp": stamp(wall_ns), "frame_id": frame_id, "data": data, "format": "jpeg"})
