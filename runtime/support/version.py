"""Version of the installed phasestack package."""

from __future__ import annotations

from functools import cache


@cache
def version() -> str:
    """Return the version of phasestack, or `unknown` if the package is not installed."""
    from importlib.metadata import PackageNotFoundError
    from importlib.metadata import version as installed

    try:
        return installed("phasestack")
    except PackageNotFoundError:
        return "unknown"
