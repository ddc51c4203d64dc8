"""Folders for what outlives a run."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path


def state_folder() -> Path:
    """The service's own state folder (systemd's), else the person's."""
    if given := os.environ.get("STATE_DIRECTORY", ""):
        return Path(given.split(":")[0])
    own, home = os.environ.get("XDG_STATE_HOME", ""), os.environ.get("HOME", "")
    if Path(own).is_absolute():
        return Path(own) / "phasestack"
    if home:
        return Path(home) / ".local" / "state" / "phasestack"
    return Path(tempfile.gettempdir()) / f"phasestack-state-{os.geteuid()}"
