"""Where black boxes are written."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping
from pathlib import Path


def state_folder(environment: Mapping[str, str] = os.environ) -> Path:
    """The service's own state folder (systemd's), else the person's."""
    if given := environment.get("STATE_DIRECTORY", ""):
        return Path(given.split(":")[0])
    own = environment.get("XDG_STATE_HOME", "")
    if Path(own).is_absolute():
        return Path(own) / "phasestack"
    home = environment.get("HOME", "")
    return Path(home) / ".local" / "state" / "phasestack" if home else Path(tempfile.gettempdir()) / "phasestack"


def black_box_folder(configured: str) -> Path:
    """configured: `service.blackbox_folder`; empty: a folder in the state folder."""
    return Path(configured) if configured else state_folder() / "blackbox"
