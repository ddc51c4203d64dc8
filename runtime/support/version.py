"""Which version this is."""

from __future__ import annotations

from functools import cache


@cache
def version() -> str:
    """As the installed package says; `unknown` where it is run from a folder that is not installed."""
    from importlib.metadata import PackageNotFoundError
    from importlib.metadata import version as installed

    try:
        return installed("phasestack")
    except PackageNotFoundError:
        return "unknown"
