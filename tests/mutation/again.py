"""One survivor again: its edit in place of the module, and the module's tests, in a process of its own.

`python -m tests.mutation.again MODULE MUTANT DIFF-FILE`: rc 0: the tests pass with it, 1: they fail, 2: it has none.
"""

from __future__ import annotations

import ast
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from tests.mutation.imports import put_in_place_of
from tests.mutation.modules import MODULES

ROOT = Path(__file__).resolve().parents[2]
CANT = 2
TIMEOUT_S = 600


def edited(text: str, mutant: str, diff: str) -> str:
    """A module with one line of a function replaced or left out, as a diff has it.

    mutant: mutmut's name, as in `runtime.optics.views.x_stack_from_eye__mutmut_3`. A method's diff is told without the
    class's indentation: lines are compared without theirs. Raises ValueError where the line is not in that function
    exactly once.
    """
    old = [line[1:].strip() for line in diff.splitlines() if line.startswith("-")]
    new = [line[1:].strip() for line in diff.splitlines() if line.startswith("+")]
    lines = text.splitlines()
    first, last = _lines_of(text, mutant)
    places = [number for number in range(first - 1, last) if [lines[number].strip()] == old]
    if len(places) != 1 or len(new) > 1:
        raise ValueError(f"{mutant}: not one line in one place: {diff}")
    before = lines[places[0]]
    lines[places[0] : places[0] + 1] = [before[: len(before) - len(before.lstrip())] + line for line in new]
    return "\n".join(lines) + "\n"


def _lines_of(text: str, mutant: str) -> tuple[int, int]:
    """First and last line of a mutant's function, from 1. Raises ValueError where there is none."""
    name = mutant.rpartition(".")[2].rpartition("__mutmut_")[0]
    *classes, function = name.split("\u01c1")[1:] if "\u01c1" in name else [name.removeprefix("x_")]
    node: ast.AST = ast.parse(text)
    for part in (*classes, function):
        found = [child for child in ast.iter_child_nodes(node) if getattr(child, "name", None) == part]
        if len(found) != 1:
            raise ValueError(f"{mutant}: {part} is not there once")
        node = found[0]
    assert isinstance(node, ast.FunctionDef) and node.end_lineno is not None
    return node.lineno, node.end_lineno


def survives(module: str, mutant: str, diff: str) -> bool | None:
    """Whether a module's own tests pass with an edit; None: it can't be placed. Longer than TIMEOUT_S: they fail."""
    with tempfile.NamedTemporaryFile("w", suffix=".diff", encoding="utf-8") as file:
        file.write(diff)
        file.flush()
        command = [sys.executable, "-m", "tests.mutation.again", module, mutant, file.name]
        try:
            code = subprocess.run(command, cwd=ROOT, capture_output=True, timeout=TIMEOUT_S).returncode
        except subprocess.TimeoutExpired:
            return False
    return None if code == CANT else code == 0


def main(module: str, mutant: str, file: str) -> int:
    path = ROOT / (module.replace(".", "/") + ".py")
    try:
        text = edited(path.read_text(encoding="utf-8"), mutant, Path(file).read_text(encoding="utf-8"))
        finder = put_in_place_of(module, compile(text, str(path), "exec"))
    except (ValueError, SyntaxError):
        return CANT
    code = pytest.main(["-q", "-x", "-m", "not slow", "-p", "no:cacheprovider", *MODULES[module]])
    assert finder.used or code, "the module was not imported"
    return int(code != 0)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
