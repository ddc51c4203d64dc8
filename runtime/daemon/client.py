"""Asking the running daemon: one JSON line there, one back."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from runtime.errors import TransientError


class NotRunning(TransientError):
    """No daemon answers at the socket; the text says why, and what to do."""


def ask(paths: Iterable[Path], request: dict[str, Any], *, timeout_s: float = 10.0) -> dict[str, Any]:
    """The daemon's answer. Raises NotRunning where none answers, within the time, at any of the paths."""
    problems = []
    for path in paths:
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
                connection.settimeout(timeout_s)
                connection.connect(str(path))
                connection.sendall(json.dumps(request).encode() + b"\n")
                with connection.makefile("rb") as stream:
                    line = stream.readline()
            answer = json.loads(line)
        except (OSError, ValueError) as error:
            problems.append(f"{path}: {_advice(error)}")
            continue
        if isinstance(answer, dict):
            return answer
        problems.append(f"{path}: answered nonsense")
    raise NotRunning("; ".join(problems) or "no socket is configured")


def _advice(error: Exception) -> str:
    match error:
        case FileNotFoundError():
            return "no daemon (start it: systemctl start phasestack)"
        case PermissionError():
            return "not permitted (be a member of the service's group)"
        case ConnectionRefusedError():
            return "nobody listens (the daemon has died: systemctl status phasestack)"
        case TimeoutError():
            return "no answer in time (the daemon hangs)"
    return str(error) or type(error).__name__
