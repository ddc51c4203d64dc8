"""Third-party notices are complete and up to date."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

from runtime.support.licences import HEAD, closure, licence, notices

PAGE = Path(__file__).parents[2] / "THIRD_PARTY.md"


def names(text: str) -> set[str]:
    rows = text.removeprefix(HEAD).split("\n\n")[0].splitlines()
    return {row.split(" | ")[0].removeprefix("| ") for row in rows}


def test_the_page_in_the_repository_lists_what_is_installed():
    assert names(PAGE.read_text()) == names(notices())


def test_every_pinned_dependency_is_listed():
    dependencies = tomllib.loads((PAGE.parent / "pyproject.toml").read_text())["project"]["dependencies"]
    pinned = [re.split(r"[\[=]", dependency)[0] for dependency in dependencies]
    assert len(pinned) > 10
    listed = {name.lower().replace("_", "-") for name in names(PAGE.read_text())}
    assert {name.lower().replace("_", "-") for name in pinned} <= listed


def test_every_licence_is_known():
    for package in closure("phasestack"):
        assert licence(package) not in ("", "see its texts"), package.name
