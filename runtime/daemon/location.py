"""Where a daemon's socket is, seen from a client."""

from __future__ import annotations

import os
import tomllib
from pathlib import Path
from typing import Any

from runtime.errors import InputError
from runtime.support import foreign

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


def configured_socket(config: Path | None) -> str:
    """The socket that a configuration names. Nothing else of it is looked at: a client is started quickly.

    Raises InputError, naming the file and the field.
    """
    if config is None:
        return DEFAULT_SOCKET
    try:
        text = foreign.read_text(config)
        is_json = config.suffix.lower() == ".json"
        table: Any = foreign.parsed_json(text, source=config) if is_json else tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(config, "", f"malformed: {error}") from None
    service = table.get("service", {}) if isinstance(table, dict) else {}
    socket = service.get("socket", DEFAULT_SOCKET) if isinstance(service, dict) else DEFAULT_SOCKET
    if not isinstance(socket, str) or not socket or "\0" in socket:
        raise InputError(config, "service.socket", "names no file")
    return str(config.absolute().parent / socket)
