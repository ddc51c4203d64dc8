"""Load the libOpenNI2 library and its drivers.

The `openni` package expects a folder that contains `libOpenNI2.so` and `OpenNI2/Drivers/`. Because Linux distributions
install these files under other names, this module creates a folder of links. Drivers stay in memory: some drivers leave
threads running after closing a device, and unloading their code would crash the process.
"""

from __future__ import annotations

import ctypes
import os
import tempfile
from pathlib import Path
from typing import Any

from runtime.errors import MissingPart, SensorLost
from runtime.support.extras import missing_extra

LIBRARY_FOLDERS = (
    "/usr/lib/x86_64-linux-gnu",
    "/usr/lib/aarch64-linux-gnu",
    "/usr/lib64",
    "/usr/lib",
    "/usr/local/lib",
)
DUMMY = "DummyDevice"  # OpenNI2's sample driver, which would add a fake device
INSTALL = "OpenNI2 was not found; install libopenni2-0 or set sensor.openni2_folder"

_loaded = False


def find_library(folder: str = "") -> tuple[Path, Path]:
    """Return the library and its driver folder in a folder, or in `LIBRARY_FOLDERS`. Raises MissingPart."""
    for place in (folder,) if folder else LIBRARY_FOLDERS:
        drivers = Path(place) / "OpenNI2" / "Drivers"
        for library in sorted(Path(place).glob("libOpenNI2.so*")):
            if drivers.is_dir():
                return library, drivers
    raise MissingPart(f"{folder} must contain libOpenNI2.so and OpenNI2/Drivers" if folder else INSTALL)


def load(folder: str = "") -> Any:
    """Load the library, from `folder` or `LIBRARY_FOLDERS`, and return the module `openni.openni2`.
    Raises MissingPart without the package or the library, and SensorLost if it cannot be started.
    """
    global _loaded
    try:
        from openni import openni2
    except ImportError as error:
        raise missing_extra(error) or error from None
    if _loaded:
        return openni2
    library, drivers = find_library(folder)
    with tempfile.TemporaryDirectory(prefix="phasestack-openni2-") as folder_of_links:
        links = Path(folder_of_links)
        (links / "OpenNI2" / "Drivers").mkdir(parents=True)
        (links / "libOpenNI2.so").symlink_to(library)
        for file in sorted(drivers.glob("lib*.so*")):
            if DUMMY not in file.name:
                # Debian's library looks for lib*.so.0, and the original library for lib*.so.
                for name in {file.name, f"{file.name.split('.so')[0]}.so", f"{file.name.split('.so')[0]}.so.0"}:
                    (links / "OpenNI2" / "Drivers" / name).symlink_to(file)
        try:
            openni2.initialize(str(links))
        except Exception as error:
            raise SensorLost(f"OpenNI2 failed to start: {error}") from None
        for file in (links / "OpenNI2" / "Drivers").iterdir():
            ctypes.CDLL(str(file), mode=os.RTLD_NOW | os.RTLD_NODELETE)
    _loaded = True
    return openni2
