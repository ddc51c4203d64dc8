"""Where a daemon's socket is, seen from a client."""

from __future__ import annotations

import os
from pathlib import Path


def user_socket() -> Path | None:
    """The socket of a daemon that runs in a person's own session; None outside a session."""
    runtime_dir = os.environ.get("XDG_RUNTIME_DIR", "")
    return Path(runtime_dir) / "phasestack" / "status.sock" if runtime_dir else None


def candidates(configured: str) -> tuple[Path, ...]:
    """Where to look, in this order: the configured socket, then the person's own."""
    own = user_socket()
    return (Path(configured),) if own is None else (Path(configured), own)
