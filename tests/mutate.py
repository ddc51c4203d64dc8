"""Change one place of a room at a time, and count how many changes its tests notice (`make mutate ROOM=frame`).

Python is changed in its syntax tree: comparisons, logic, arithmetic, numbers, and statements that are left out. C++ is
changed by its operators, and the kernels are rebuilt. Everything happens in a copy of the tree.
"""

from __future__ import annotations

import argparse
import ast
import copy
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
COPIED = ("runtime", "calib", "model_export", "phasestack", "tests", "examples", "docs", "systemd", "pyproject.toml")
TESTS_OF = {
    "kernels": ("model", "panels", "optics"),
    "plan": ("plan", "frame"),
    "browser": ("daemon", "browser"),
    "page": ("page", "browser"),
}
LONGEST = 5.0  # tests that take this many times longer than without a change have noticed it
SWAPPED: dict[type[ast.AST], type[ast.AST]] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.And: ast.Or, ast.Or: ast.And, ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip
OPERATORS = re.compile(r"(?<= )(<=|>=|==|!=|&&|\|\||[+*<>-])(?= )")
OTHER_OPERATOR = {"<": "<=", "<=": "<", ">": ">=", ">=": ">", "==": "!=", "!=": "==", "&&": "||", "||": "&&",
                  "+": "-", "-": "+", "*": "+"}  # fmt: skip
BUILD = ("-c", "from setuptools import setup; setup()", "-q", "build_ext", "--inplace")


@dataclass(frozen=True, slots=True)
class Mutation:
    """One changed place of a file."""

    path: Path  # relative to the root
    start: int  # byte offsets of the text that is replaced
    end: int
    text: bytes

    def applied(self, source: bytes) -> bytes:
        return source[: self.start] + self.text + source[self.end :]

    def describe(self, source: bytes) -> str:
        line, old = source[: self.start].count(b"\n") + 1, source[self.start : self.end].decode()
        return f"{self.path}:{line}: {' '.join(old.split())[:60]!r} -> {' '.join(self.text.decode().split())[:60]!r}"


def mutations_of(path: Path, source: bytes) -> Iterator[Mutation]:
    """Yield every change of a file, of Python by its syntax and of C++ by its operators."""
    if path.suffix != ".py":
        for found in OPERATORS.finditer(
            re.sub(r"//.*", lambda comment: " " * len(comment[0]), source.decode("latin1"))
        ):
            yield Mutation(path, *found.span(), OTHER_OPERATOR[found[0]].encode())
        return
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    for node in ast.walk(_without_annotations(ast.parse(source))):
        for changed in _changed(node):
            start, end = starts[node.lineno - 1] + node.col_offset, starts[node.end_lineno - 1] + node.end_col_offset
            text = f"({ast.unparse(changed)})" if isinstance(changed, ast.expr) else ast.unparse(changed)
            yield Mutation(path, start, end, text.encode())


def _without_annotations(tree: ast.Module) -> ast.Module:
    for node in ast.walk(tree):
        for name in ("annotation", "returns"):
            if getattr(node, name, None) is not None:
                setattr(node, name, ast.Constant(None, lineno=1, col_offset=0, end_lineno=1, end_col_offset=0))
    return tree


def _changed(node: Any) -> Iterator[ast.AST]:
    """Yield a node's mutated copies."""
    if isinstance(node, ast.Compare) and type(node.ops[0]) in SWAPPED:
        changed: Any = copy.deepcopy(node)
        changed.ops[0] = SWAPPED[type(node.ops[0])]()
        yield changed
    elif isinstance(node, ast.BoolOp | ast.BinOp) and type(node.op) in SWAPPED:
        changed = copy.deepcopy(node)
        changed.op = SWAPPED[type(node.op)]()
        yield changed
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        yield node.operand
    elif isinstance(node, ast.Constant) and isinstance(node.value, bool):
        yield ast.Constant(not node.value)
    elif isinstance(node, ast.Constant) and isinstance(node.value, int | float):
        yield ast.Constant(node.value * 2 if node.value else 1)
    elif isinstance(node, ast.AugAssign) or (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Call)
        and not ast.unparse(node).startswith(("log.", "super()."))
    ):
        yield ast.Pass()


class Tree:
    """Copy of the project in which one file at a time is changed."""

    def __init__(self, folder: Path, room: str) -> None:
        self.folder, self.room = folder, room
        for name in COPIED:
            (shutil.copytree if (ROOT / name).is_dir() else shutil.copy)(ROOT / name, folder / name)

    def tests_pass(self, timeout_s: float | None) -> bool:
        """Return True if the tests of the room, or of its part, pass. Then they have not noticed the change."""
        room, _, part = self.room.partition("/")
        own = self.folder / "tests" / room / f"test_{part}.py"
        folders = [str(own)] if own.exists() else [f"tests/{name}" for name in TESTS_OF.get(room, (room,))]
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-m", "not slow", "-p", "no:cacheprovider", *folders]
        environment = os.environ | {"PYTHONPATH": str(self.folder), "PYTHONDONTWRITEBYTECODE": "1"}
        try:
            done = subprocess.run(
                command, cwd=self.folder, env=environment, capture_output=True, timeout=timeout_s, check=False
            )
        except subprocess.TimeoutExpired:
            return False
        return done.returncode == 0

    def survives(self, mutation: Mutation, timeout_s: float) -> bool:
        """Return True if the tests pass in spite of the mutation. A kernel that is not compiled has been noticed."""
        path = self.folder / mutation.path
        source = path.read_bytes()
        path.write_bytes(mutation.applied(source))
        try:
            if path.suffix != ".py":
                built = subprocess.run([sys.executable, *BUILD], cwd=self.folder, capture_output=True, check=False)
                if built.returncode:
                    return False
            return self.tests_pass(timeout_s)
        finally:
            path.write_bytes(source)


def files_of(room: str) -> list[Path]:
    """Return the files of a room (`frame`, `calib`) or of a part of one (`content/playlist`), relative to the root."""
    places = [ROOT / "runtime" / room, ROOT / room, (ROOT / "runtime" / room).with_suffix(".py"), ROOT / f"{room}.py"]
    place = next((place for place in places if place.exists()), None)
    if place is None:
        raise SystemExit(f"there is no room {room}")
    files = [place] if place.is_file() else sorted(place.rglob("*.py" if room != "kernels" else "*.?pp"))
    return [file.relative_to(ROOT) for file in files]


def main() -> int:
    """Run the mutations, print the survivors, and return 1 if fewer than the required share was noticed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("room", help="such as frame, content/playlist or kernels")
    parser.add_argument("--count", type=int, default=40, help="mutations to try, chosen at random")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--at-least", type=float, default=0.8, help="share that must be noticed")
    told = parser.parse_args()
    files = {path: (ROOT / path).read_bytes() for path in files_of(told.room)}
    every = [mutation for path, source in files.items() for mutation in mutations_of(path, source)]
    chosen = random.Random(told.seed).sample(every, min(told.count, len(every)))
    with tempfile.TemporaryDirectory() as folder:
        tree = Tree(Path(folder), told.room)
        begun = time.monotonic()
        if not tree.tests_pass(None):
            raise SystemExit(f"the tests of {told.room} fail without any change")
        timeout_s = LONGEST * (time.monotonic() - begun) + 10
        survivors = 0
        for number, mutation in enumerate(chosen, 1):
            survived = tree.survives(mutation, timeout_s)
            survivors += survived
            outcome = "SURVIVED" if survived else "noticed"
            print(f"{number}/{len(chosen)} {outcome} {mutation.describe(files[mutation.path])}", flush=True)
    share = 1 - survivors / max(len(chosen), 1)
    print(f"{told.room}: {len(chosen) - survivors} of {len(chosen)} mutations noticed ({share:.0%})")
    return int(share < told.at_least)


if __name__ == "__main__":
    sys.exit(main())
