"""Folder for data kept between runs."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path


def state_folder() -> Path:
    """Return the systemd service's or the user's state folder or, without a home folder, a temporary one."""
    if service := os.environ.get("STATE_DIRECTORY", ""):
        return Path(service.split(":")[0])
    xdg, home = os.environ.get("XDG_STATE_HOME", ""), os.environ.get("HOME", "")
    if Path(xdg).is_absolute():
        return Path(xdg) / "phasestack"
    if home:
        return Path(home) / ".local" / "state" / "phasestack"
    return Path(tempfile.gettempdir()) / f"phasestack-state-{os.geteuid()}"
