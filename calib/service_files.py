"""All that the service reads, gathered in one folder: it sees nobody's home."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import tomlkit

from calib.config_file import read_document
from runtime.config import NAMES_OR_PATHS, PATHS, load_settings
from runtime.errors import InputError
from runtime.support import untrusted_input
from runtime.support.artifacts import OutputFolder, write_bytes, write_text

MAX_BYTES = 64 << 20
CONFIG = "phasestack.toml"
CALIBRATION = "calibration.toml"


def gather(config: Path, out: Path) -> list[str]:
    """Write the configuration with its calibration and grey curves beside it; returns the files' names.

    Other files that it names stay where they are, named in full. Raises InputError where one cannot be read.
    """
    if not config.exists():
        raise InputError(config, "", "there is nothing to install yet: the steps before this one")
    settings = load_settings(config)
    document: Any = read_document(config)
    copies: dict[str, bytes] = {}
    for section, key in (*PATHS, *NAMES_OR_PATHS):
        value = getattr(getattr(settings, section), key)
        if value and key in document.get(section, {}):
            document[section][key] = value
    if settings.calibration.file:
        copies[CALIBRATION] = untrusted_input.read_bytes(settings.calibration.file, most_bytes=MAX_BYTES)
        document["calibration"]["file"] = CALIBRATION
    for number, panel in enumerate(settings.output.panels):
        if panel.lut:
            name = f"panel-{number}.csv"
            copies[name] = untrusted_input.read_bytes(panel.lut, most_bytes=MAX_BYTES)
            document["output"]["panels"][number]["lut"] = name
    with OutputFolder(out) as folder:
        for name, data in copies.items():
            write_bytes(folder.staging / name, data)
        write_text(folder.staging / CONFIG, tomlkit.dumps(document))
        load_settings(folder.staging / CONFIG)
    return sorted([CONFIG, *copies])
