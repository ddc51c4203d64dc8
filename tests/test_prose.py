"""Tests that prose contains no phrase that `[tool.prose]` in pyproject.toml forbids."""

from __future__ import annotations

import ast
import io
import re
import tokenize
import tomllib
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
SETTINGS = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["prose"]
FORBIDDEN = re.compile("|".join(SETTINGS["never"]), re.IGNORECASE)
OPENINGS = re.compile(f"(?:{'|'.join(SETTINGS['never_opens_a_docstring'])})\\b")
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def passages(path: Path) -> Iterator[tuple[int, str]]:
    """Line and text of every comment, docstring and message of a file, or line of a page, without quoted code."""
    text = path.read_text()
    if path.suffix == ".py":
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value:
                yield node.lineno, re.sub(r"`[^`]*`", "", node.value)
        for token in tokenize.generate_tokens(io.StringIO(text).readline):
            if token.type == tokenize.COMMENT:
                yield token.start[0], re.sub(r"`[^`]*`", "", token.string)
        return
    pattern = r"(.*)" if path.suffix == ".md" else r".*?(?:^|\s)//(.*)"
    for number, line in enumerate(text.splitlines(), 1):
        if comment := re.match(pattern, line):
            yield number, re.sub(r"`[^`]*`", "", comment[1])


def prose_files() -> list[Path]:
    """Files with prose in the clean rooms."""
    suffixes, rooms = {".py", ".md", ".cpp", ".hpp", ".glsl", ".js"}, [ROOT / name for name in SETTINGS["rooms"]]
    missing = [str(path) for path in rooms if not path.exists()]
    assert not missing, f"pyproject.toml: [tool.prose] names {', '.join(missing)}"
    every = (path for room in rooms for path in (room.rglob("*") if room.is_dir() else [room]))
    return sorted(path for path in every if path.suffix in suffixes)


def test_clean_rooms_use_no_forbidden_phrase() -> None:
    faults = [
        f"{path.relative_to(ROOT)}:{line}: {phrase[0]}"
        for path in prose_files()
        for line, text in passages(path)
        for phrase in FORBIDDEN.finditer(text)
    ]
    assert not faults, "\n".join(faults)


def test_docstrings_of_clean_rooms_open_with_a_noun_or_verb() -> None:
    faults = [
        f"{path.relative_to(ROOT)}:{getattr(node, 'lineno', 1)}: {doc[:40]}"
        for path in prose_files()
        if path.suffix == ".py"
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, DOCUMENTED) and OPENINGS.match(doc := ast.get_docstring(node) or "")
    ]
    assert not faults, "\n".join(faults)
