"""Version of the installed package."""

from __future__ import annotations

from functools import cache


@cache
def version() -> str:
    """Return the version of the installed package, or `unknown` without an installation."""
    from importlib.metadata import PackageNotFoundError
    from importlib.metadata import version as installed

    try:
        return installed("phasestack")
    except PackageNotFoundError:
        return "unknown"
