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


def listed() -> dict[str, tuple[str, str]]:
    """Home and licence by name, as the page has them."""
    groups = re.findall(r"^\* (.+?): (\[.+)$", TEXT, re.MULTILINE)
    links = [(*link, licence) for licence, row in groups for link in re.findall(r"\[([^]]+)\]\(([^)]+)\)", row)]
    return {plain(name): (home, licence) for name, home, licence in links}


def test_the_page_lists_exactly_the_packages_of_the_runtime_s_lock() -> None:
    assert listed().keys() == {plain(name) for name in script().locked()}


def test_every_licence_is_known_and_as_the_package_says() -> None:
    assert all(licence not in {"", "UNKNOWN"} for _, licence in listed().values())
    (told,) = script().licences(["numpy"])
    assert listed()["numpy"] == (told["URL"], told["License"])
