"""Find the phasestack extra that installs a missing optional package."""

from __future__ import annotations

import re
from importlib.metadata import PackageNotFoundError, requires

from runtime.errors import MissingPart

IMPORTED_AS = {"usb": "pyusb"}  # packages whose modules have different names
NOT_TO_RUN = frozenset({"all", "docs", "test"})  # extras that are never suggested to a user


def missing_extra(error: BaseException) -> MissingPart | None:
    """Return an error that names the extra to install after a failed import, or None for other reasons."""
    if not isinstance(error, ModuleNotFoundError) or not error.name:
        return None
    module = error.name.partition(".")[0]
    package = IMPORTED_AS.get(module, module).replace("_", "-")
    for extra in _extras_with(package):
        return MissingPart(f"{package} is not installed; run: pip install 'phasestack[{extra}]'")
    return None


def _extras_with(package: str) -> list[str]:
    """Return the names of the extras that contain a package, in the order of pyproject.toml."""
    try:
        lines = requires("phasestack") or []
    except PackageNotFoundError:
        return []
    pattern = re.compile(rf"{re.escape(package)}\b(?!-).*extra == ['\"]([\w-]+)['\"]", re.IGNORECASE)
    extras = [match[1] for line in lines if (match := pattern.match(line.replace("_", "-")))]
    return [extra for extra in extras if extra not in NOT_TO_RUN]
