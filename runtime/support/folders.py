"""Folder for data that is kept between runs."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path


def state_folder() -> Path:
    """Return the state folder of the systemd service or, if not run as a service, of the user.

    Without a home folder, the result is a folder among the temporary files.
    """
    if service := os.environ.get("STATE_DIRECTORY", ""):
        return Path(service.split(":")[0])
    xdg, home = os.environ.get("XDG_STATE_HOME", ""), os.environ.get("HOME", "")
    if Path(xdg).is_absolute():
        return Path(xdg) / "phasestack"
    if home:
        return Path(home) / ".local" / "state" / "phasestack"
    return Path(tempfile.gettempdir()) / f"phasestack-state-{os.geteuid()}"
