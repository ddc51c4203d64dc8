"""Tests that the page of third-party licences is complete and up to date."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "THIRD_PARTY.md").read_text(encoding="utf-8")


def script() -> Any:
    spec = importlib.util.spec_from_file_location("make_licences", ROOT / "docs" / "make_licences.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def plain(name: str) -> str:
    return name.lower().replace("_", "-")


def listed() -> dict[str, list[str]]:
    """Home, version and licence by name, as the page has them."""
    rows = re.findall(r"^\* \[(.+)\]\((.+)\) (\S+): (.+)$", TEXT, re.MULTILINE)
    return {plain(name): rest for name, *rest in rows}


def test_the_page_lists_exactly_the_packages_of_the_runtime_s_lock() -> None:
    locked = {plain(name): version for name, version in script().locked().items()}
    assert {name: version for name, (_, version, _) in listed().items()} == locked


def test_every_licence_is_known_and_as_the_package_says() -> None:
    assert all(licence not in {"", "UNKNOWN"} for *_, licence in listed().values())
    (told,) = script().licences(["numpy"])
    assert listed()["numpy"] == [told["URL"], told["Version"], told["License"]]
