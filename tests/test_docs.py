"""Tests that links and names in pages exist, and that their commands, Python and TOML are valid."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import inspect
import re
import shlex
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import pytest
import typer

import phasestack
from runtime.commands.app import app
from runtime.config import Settings
from runtime.daemon.commands import NAMES

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
CLI: Any = typer.main.get_command(app)
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *DOCS.rglob("*.md")])
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
IN_A_SENTENCE = re.compile(r"`phasestack ([^`]* --[^`]+)`")
BLOCK = re.compile(r"^```\w*\n((?:.*\n)*?)```$|(?<=\n\n)((?: {4}.*\n(?:\n(?= {4}))*)+)", re.MULTILINE)
PROGRAM = re.compile(r"(?<!-u)(?:^|\s)(?:\S+/)?phasestack (?=[a-z-])")
NUMBERS = dict.fromkeys(("N", "S", "W", "H", "DEG", "SEED"), "3")
MEANT = NUMBERS | {
    "X": "0.5",
    "Y": "0",
    "Z": "0",
    "F": "1",
    "M": "0.001",
    "R": "30",
    "NAME": "walk",
}  # of what contracts.md has in capitals
CHEAP = (  # run, too: they need nothing and take about a second
    "calibrate capture --replay demo --out demo-pairs.csv",
    "config",
    "record --motion walk --seed 3 --rate-hz 60 --out walk.mcap",
)
NOT_INSTALLED = ("pyvista",)  # of extras that the tests do without


def walk(command: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Every command and group below one, with the words that call it."""
    yield path, command
    for name, child in getattr(command, "commands", {}).items():
        yield from walk(child, (*path, name))


def blocks_of(page: Path) -> list[str]:
    """Code blocks of a page, fenced or indented, without their indentation."""
    found = BLOCK.findall(page.read_text(encoding="utf-8") + "\n")
    return [fenced or re.sub(r"^ {4}", "", indented, flags=re.MULTILINE) for fenced, indented in found]


def is_python(block: str) -> bool:
    return bool(re.search(r"^(?:import|from|class) \w|phasestack\.\w+\(", block, re.MULTILINE))


def calls_in(block: str) -> Iterator[list[str]]:
    """The words after `phasestack` in a block's shell commands: remarks off, continued lines joined."""
    for line in re.sub(r"\\\n|\n(?=\s+\[?--)", " ", block).splitlines():
        if found := PROGRAM.search(line):
            words = shlex.split(line[found.end() :], comments=True)
            ends = [k for k, word in enumerate(words) if word in ("|", "&&")]
            yield words[: min(ends, default=len(words))]


def meant(words: list[str]) -> list[str]:
    """A line of contracts.md (`[--scene NAME|FILE]`) as what could be typed: every option, the first alternative."""
    plain = [word.strip("[]()").partition("|")[0] for word in words if word != "...]"]
    return [MEANT.get(word, word) for word in plain]


def shown_commands() -> list[tuple[str, list[str]]]:
    """Every call of phasestack that a page shows as code: the page, the words after the program's name."""
    shell = [(page.name, block) for page in PAGES for block in blocks_of(page) if not is_python(block)]
    calls = [(page, words) for page, block in shell for words in calls_in(block)]
    return [(page, meant(words) if page == "contracts.md" else words) for page, words in calls]


def parse(words: list[str]) -> None:
    """Parse the words with the command's own parser, without running it."""
    command, left, name = CLI, list(words), "phasestack"
    while hasattr(command, "commands") and left and left[0] in command.commands:
        name = f"{name} {left[0]}"
        command = command.commands[left.pop(0)]
    if hasattr(command, "commands") and left and not left[0].startswith("-"):
        raise ValueError(f"no such command: {left[0]}")
    command.make_context(name, left)


def alternatives(name: str) -> list[str]:
    """`a/{b,c}.json` as a/b.json and a/c.json."""
    head, brace, rest = name.partition("{")
    inner, _, tail = rest.partition("}")
    return [head + one + tail for one in inner.split(",")] if brace else [name]


def test_every_command_has_an_example_and_says_what_its_options_are() -> None:
    for path, command in walk(CLI):
        name = " ".join(("phasestack", *path))
        assert f"Example: {name}" in command.help, name
        assert [parameter.name for parameter in command.params if not parameter.help] == [], name


def test_every_command_that_a_page_shows_is_taken_by_the_parser() -> None:
    shown = shown_commands()
    assert len(shown) > 80 and len({page for page, _ in shown}) > 15
    for page, words in shown:
        try:
            parse(words)
        except Exception as error:
            pytest.fail(f"{page}: phasestack {' '.join(words)}: {error}")


@pytest.mark.parametrize(
    "wrong", ["run --frams 3", "solve --left-eye 1 2", "ctl plaice", "stability stiff", "run --frames x"]
)
def test_a_command_that_a_page_had_wrong_would_be_found(wrong: str) -> None:
    (words,) = calls_in(f"sudo .venv/bin/phasestack {wrong}  # as it stood\n")
    with pytest.raises(Exception, match=r"(?i)option|argument|command|valid|expected"):
        parse(words)


def test_options_named_in_a_sentence_exist() -> None:
    known = dict(walk(CLI))
    for page in PAGES:
        for line in IN_A_SENTENCE.findall(page.read_text(encoding="utf-8")):
            words = line.split()
            name = max((path for path in known if tuple(words[: len(path)]) == path), key=len)
            options = {option for parameter in known[name].params for option in parameter.opts} | {"--help"}
            assert name and {word for word in words if word.startswith("--")} <= options, f"{page.name}: {line}"


def test_operation_s_table_has_the_commands_of_ctl() -> None:
    typed = {path[-1] for path, _ in walk(CLI) if path[:1] == ("ctl",)} - {"ctl"}
    page = (DOCS / "operation.md").read_text(encoding="utf-8")
    table = page.partition("| `phasestack ctl` |")[2].partition("\n\n")[0]
    listed = re.findall(r"`([a-z]+)[^`]*`", " ".join(row.split(" | ")[0] for row in table.splitlines()))
    assert sorted(listed) == sorted(typed) == sorted(set(NAMES) - {"next"})  # `scene next`, as it is typed


@pytest.mark.parametrize("line", CHEAP)
def test_a_cheap_command_of_the_pages_runs(line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert line.split() in [words for _, words in shown_commands()]
    monkeypatch.chdir(tmp_path)
    app(line.split(), standalone_mode=False)
    assert "--out" not in line or (tmp_path / line.split("--out ")[1]).exists()


def test_python_that_a_page_shows_compiles_and_names_what_is_there() -> None:
    blocks = [(page.name, block) for page in PAGES for block in blocks_of(page) if is_python(block)]
    assert len(blocks) >= 7
    for page, block in blocks:
        for node in ast.walk(ast.parse(block, page)):
            if isinstance(node, ast.Import):
                [importlib.import_module(name.name) for name in node.names if name.name not in NOT_INSTALLED]
            elif isinstance(node, ast.ImportFrom):
                assert all(hasattr(importlib.import_module(str(node.module)), name.name) for name in node.names), page
            elif isinstance(node, ast.Call) and ast.unparse(node.func).startswith("phasestack."):
                called = getattr(phasestack, ast.unparse(node.func).partition(".")[2])
                inspect.signature(called).bind(*node.args, **{name.arg or "": None for name in node.keywords})


def unknown(model: Any, table: dict[str, Any]) -> set[str]:
    """The keys of a TOML table, and of the tables in it, that a settings model does not have."""
    wrong = table.keys() - model.model_fields.keys()
    for name in table.keys() - wrong:
        inner = model.model_fields[name].annotation
        inner = next(iter(get_args(inner)), inner)
        for part in table[name] if isinstance(table[name], list) else [table[name]]:
            wrong |= unknown(inner, part) if isinstance(part, dict) and hasattr(inner, "model_fields") else set()
    return wrong


def test_settings_that_a_page_shows_are_settings() -> None:
    texts = [text for page in PAGES for block in blocks_of(page) for text in block.split("\n\n") if text[0] == "["]
    assert len(texts) >= 5
    for table in map(tomllib.loads, texts):
        for entry in table.pop("show", []):
            table["content"] = {name: value for name, value in entry.items() if name != "seconds"}
            assert unknown(Settings, table) == set()
        assert unknown(Settings, table) == set()


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


def test_names_of_tests_have_at_most_twelve_words() -> None:
    names = [name for path in (ROOT / "tests").rglob("test_*.py") if path.parent.name not in ("model", "plan")
             for name in re.findall(r"^\s*def test_(\w+)", path.read_text(encoding="utf-8"), re.MULTILINE)]  # fmt: skip
    assert len(names) > 800 and [name for name in names if len(name.strip("_").split("_")) > 12] == []


def public_docstrings() -> Iterator[tuple[str, str]]:
    """The docstring of every module, and of every public class and function in it, by file."""
    for package in ("calib", "model_export", "phasestack", "runtime"):
        for path in (ROOT / package).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                named = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef)
                if isinstance(node, ast.Module) or (named and not node.name.startswith("_")):
                    yield str(path.relative_to(ROOT)), ast.get_docstring(node) or ""


def test_the_first_line_of_a_public_docstring_is_short() -> None:
    lines = [(path, text.partition("\n")[0]) for path, text in public_docstrings()]
    assert len(lines) > 1200 and [(path, line) for path, line in lines if len(line) >= 100] == []
