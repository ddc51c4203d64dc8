"""Pages lead somewhere: links, files, targets of make and commands that they name are there."""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer

from runtime.commands.app import app

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *DOCS.rglob("*.md")])
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
EXAMPLE = re.compile(r"^ {4,}(?:sudo .*|\S*/)?(phasestack .+)$", re.MULTILINE)
IN_A_SENTENCE = re.compile(r"`(phasestack [^`]* --[^`]+)`")
REMARK = re.compile(r"\s+(?:#|&&)\s|;\s|\s{4,}")


def walk(command: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Every command and group below one, with the words that call it."""
    yield path, command
    for name, child in getattr(command, "commands", {}).items():
        yield from walk(child, (*path, name))


def shown_commands() -> Iterator[tuple[str, str]]:
    """Every call of phasestack in the pages, remarks taken off and continued lines joined: page and words."""
    for page in PAGES:
        text = re.sub(r"\s*\\\n\s*", " ", page.read_text(encoding="utf-8"))
        for line in [REMARK.split(line)[0] for line in EXAMPLE.findall(text)] + IN_A_SENTENCE.findall(text):
            for part in " ".join(line.split()).split(", "):  # `phasestack identify, doctor, status`
                yield page.name, part.removeprefix("phasestack ")


def alternatives(name: str) -> list[str]:
    """`a/{b,c}.json` as a/b.json and a/c.json."""
    head, brace, rest = name.partition("{")
    inner, _, tail = rest.partition("}")
    return [head + one + tail for one in inner.split(",")] if brace else [name]


def test_every_command_has_an_example_and_says_what_its_options_are() -> None:
    for path, command in walk(typer.main.get_command(app)):
        name = " ".join(("phasestack", *path))
        assert f"Example: {name}" in command.help, name
        assert [parameter.name for parameter in command.params if not parameter.help] == [], name


def test_every_command_that_a_page_shows_exists_with_its_options() -> None:
    known = dict(walk(typer.main.get_command(app)))
    for page, line in shown_commands():
        words = line.split()
        name = max((path for path in known if tuple(words[: len(path)]) == path), key=len)
        options = {option for parameter in known[name].params for option in parameter.opts} | {"--help"}
        assert name or words[0].startswith("["), f"{page}: {line}"
        asked = {word.strip("[];") for word in words if word.startswith(("--", "[--"))}
        assert asked <= options, f"{page}: {line}: {asked - options}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_what_a_page_names_is_there(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    links = [link.partition("#")[0] for link in LINK.findall(text) if not re.match(r"https?:|#", link)]
    assert [link for link in links if not (page.parent / link).exists()] == []
    files = re.findall(
        r"`((?:runtime|calib|model_export|phasestack|tests|docs|systemd|examples|requirements)/[\w./{},*-]*)", text
    )
    assert [name for name in files if not any(list(ROOT.glob(one)) for one in alternatives(name.rstrip("/.")))] == []
    modules = re.findall(r"python -m ((?:runtime|calib|model_export|tests)[\w.]*)", text)
    assert [name for name in modules if importlib.util.find_spec(name) is None] == []
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    calls = re.findall(r"(?:^    |`)make ([a-z][a-z -]*)", text, re.MULTILINE)
    assert {target for call in calls for target in call.split()} <= targets


def test_every_page_can_be_reached_from_the_readme() -> None:
    reached, waiting = set(), [ROOT / "README.md"]
    while waiting:
        page = waiting.pop()
        reached.add(page)
        links = (link.partition("#")[0] for link in LINK.findall(page.read_text(encoding="utf-8")))
        places = ((page.parent / link).resolve() for link in links if link.endswith(".md") and ":" not in link)
        waiting += [place for place in places if place not in reached]
    assert [page.name for page in PAGES if page not in reached] == []
