"""Asking the running daemon: where its socket is; one JSON line there, one back."""

from __future__ import annotations

import contextlib
import json
import os
import socket
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from runtime.errors import TransientError

# Where the daemon listens without a configuration: `ServiceSettings().socket`, without loading all settings.
DEFAULT_SOCKET = "/run/phasestack/status.sock"


def user_socket() -> Path | None:
    """The socket of a daemon that runs in a person's own session; None outside a session."""
    runtime_dir = os.environ.get("XDG_RUNTIME_DIR", "")
    return Path(runtime_dir) / "phasestack" / "status.sock" if runtime_dir else None


def candidates(configured: str) -> tuple[Path, ...]:
    """Where to look, in this order: the configured socket, then the person's own."""
    own = user_socket()
    return (Path(configured),) if own is None else (Path(configured), own)


def sockets(config: Path | None) -> tuple[Path, ...]:
    """The same by a configuration's file. Raises InputError, naming the file and the field."""
    if config is None:
        return candidates(DEFAULT_SOCKET)  # without loading all that settings need: a client is started quickly
    from runtime.config import load_settings

    return candidates(load_settings(config).service.socket)


class NotRunning(TransientError):
    """No daemon answers at the socket; the text says why, and what to do."""


def ask(paths: Iterable[Path], request: dict[str, Any], *, timeout_s: float = 10.0) -> dict[str, Any]:
    """The daemon's answer. Raises NotRunning where none answers at any of the paths; timeout_s: of each step."""
    problems = []
    for path in paths:
        try:
            return _exchanged(path, request, timeout_s)
        except (OSError, ValueError) as error:
            problems.append(f"{path}: {_advice(error)}")
    raise NotRunning("; ".join(problems) or "no socket is configured")


def _exchanged(path: Path, request: dict[str, Any], timeout_s: float) -> dict[str, Any]:
    """One line there and one back."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as channel:
        channel.settimeout(timeout_s)
        channel.connect(str(path))
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):  # turned away: the answer says why
            channel.sendall(json.dumps(request).encode() + b"\n")
        with channel.makefile("rb") as answers:
            line = answers.readline()
    if not line:
        raise ConnectionResetError("the connection was closed without an answer")
    answer: dict[str, Any] = json.loads(line)
    return answer


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
