"""Change one place of a room at a time, and count how many changes its tests notice (`make mutate ROOM=frame`).

Python is changed in its syntax tree: comparisons, logic, arithmetic, numbers, and statements that are left out. C++ is
changed by its operators, and the kernels are rebuilt. Everything happens in a copy of the tree. A change meets the
tests that run its line, the quickest file first; a change that no test runs has not been noticed.
"""

from __future__ import annotations

import argparse
import ast
import copy
import importlib
import json
import os
import random
import re
import resource
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import pytest
from coverage import CoverageData

ROOT = Path(__file__).parents[1]
COPIED = ("runtime", "calib", "model_export", "phasestack", "tests", "examples", "docs", "systemd", "pyproject.toml")
TESTS_OF = {
    "kernels": ("model", "panels", "optics", "content/test_fringe.py"),
    "plan": ("plan", "frame"),
    "optics": ("optics", "panels/test_presentation_table.py"),
    "panels": ("panels", "daemon/test_display.py"),
    "browser": ("daemon", "browser"),
    "page": ("page", "browser"),
}
OUTPUT = "output.txt"
RULES = """[run]
source = phasestack,runtime,calib,model_export
parallel = true
data_file = {data}
context = ${{PYTEST_CURRENT_TEST-}}
"""
STARTUP = """import os
if "COVERAGE_PROCESS_START" in os.environ:
    import coverage
    coverage.process_startup()
"""  # of each process that a test starts
OPTIONS = ("-xq", "-m", "not slow", "-p", "no:cacheprovider", "-p", "no:xdist",
           "-W", "ignore::pytest.PytestAssertRewriteWarning")  # fmt: skip
LIBRARIES = ("PIL.Image", "cv2", "hypothesis.extra.numpy", "pydantic", "scipy.optimize", "scipy.stats", "typer")
LONGEST = 5.0  # tests that need this many times their former seconds of processor time have noticed the change
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
    for node in ast.walk(_without_declarations(ast.parse(source))):
        for changed in _changed(node):
            start, end = starts[node.lineno - 1] + node.col_offset, starts[node.end_lineno - 1] + node.end_col_offset
            text = f"({ast.unparse(changed)})" if isinstance(changed, ast.expr) else ast.unparse(changed)
            yield Mutation(path, start, end, text.encode())


def _without_declarations(tree: ast.Module) -> ast.Module:
    """Return a tree without annotations, and without `frozen` and `slots`, which alter nothing that runs."""
    for node in ast.walk(tree):
        for name in ("annotation", "returns"):
            if getattr(node, name, None) is not None:
                setattr(node, name, ast.Constant(None, lineno=1, col_offset=0, end_lineno=1, end_col_offset=0))
        if isinstance(node, ast.ClassDef):
            node.decorator_list = [one for one in node.decorator_list if not ast.unparse(one).startswith("dataclass(")]
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


@dataclass(frozen=True, slots=True)
class Coverage:
    """Seconds that each test takes, and the tests that run each line, or any line inside a function, of a file."""

    seconds: dict[str, float]
    by_line: dict[Path, dict[int, set[str]]]

    def tests_of(self, mutation: Mutation, source: bytes) -> set[str]:
        """Return the tests that run a mutation. Empty: no test does, not even in a process that it starts."""
        if mutation.path.suffix != ".py":
            return set(self.seconds)
        first, last = (source[:place].count(b"\n") + 1 for place in (mutation.start, mutation.end))
        tests_by_line = self.by_line.get(mutation.path, {})
        found = [tests_by_line[line] for line in range(first, last + 1) if line in tests_by_line]
        if not found and _is_in_function(source, first):
            return set()
        tests = set().union(*found) - {""}
        if not tests or not _is_in_function(source, first):  # on import, or in another process
            tests = set().union(*tests_by_line.values()) - {""}
        return tests & set(self.seconds) or set(self.seconds)


def _is_in_function(source: bytes, line: int) -> bool:
    functions = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.FunctionDef)]
    return any(node.body[0].lineno <= line <= (node.end_lineno or 0) for node in functions)


class Chosen:
    """Plugin of pytest that runs certain tests, the quickest file first, and keeps the seconds of each."""

    def __init__(self, seconds: dict[str, float] | None = None) -> None:
        self.chosen = seconds
        self.seconds: dict[str, float] = {}

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        if self.chosen is not None:
            by_file: dict[Path, float] = {}
            items[:] = [item for item in items if item.nodeid in self.chosen]
            for item in items:
                by_file[item.path] = by_file.get(item.path, 0.0) + self.chosen[item.nodeid]
            items.sort(key=lambda item: (by_file[item.path], str(item.path), self.chosen[item.nodeid]))

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.seconds[report.nodeid] = self.seconds.get(report.nodeid, 0.0) + report.duration


class Tree:
    """Copy of the project in which one file at a time is changed."""

    def __init__(self, folder: Path, room: str) -> None:
        self.folder, self.room = folder, room
        for name in COPIED:
            (shutil.copytree if (ROOT / name).is_dir() else shutil.copy2)(ROOT / name, folder / name)

    def coverage(self) -> Coverage:
        """Run the tests of the room, or of its part, without a change, and return what each runs."""
        room, _, part = self.room.partition("/")
        own = (f"{room}/test_{part}.py",) if (self.folder / f"tests/{room}/test_{part}.py").exists() else (room,)
        places = [f"tests/{name}" for name in TESTS_OF.get(room, own)]
        seconds_file, rules = self.folder / "seconds.json", self.folder / "coverage.ini"
        rules.write_text(RULES.format(data=self.folder / ".coverage"))
        (self.folder / "sitecustomize.py").write_text(STARTUP)
        told = ("--cov", f"--cov-config={rules}", "--cov-context=test", "--cov-report=", *places)
        if self._code_of_tests(told, Chosen(), resource.RLIM_INFINITY, seconds_file) != 0:
            raise SystemExit(f"{(self.folder / OUTPUT).read_text()}the tests of {self.room} fail without any change")
        data = CoverageData(str(self.folder / ".coverage"))
        data.read()
        by_line = {
            Path(file).relative_to(self.folder): {
                line: {re.sub(r"(\|run| \(call\)|.(setup|teardown)\)?)$", "", context) for context in contexts}
                for line, contexts in data.contexts_by_lineno(file).items()
            }
            for file in data.measured_files()
        }
        return Coverage(json.loads(seconds_file.read_text()), by_line)

    def outcome(self, mutation: Mutation, seconds: dict[str, float]) -> str:
        """Return whether tests pass in spite of a mutation, and which test has noticed it."""
        path = self.folder / mutation.path
        source = path.read_bytes()
        path.write_bytes(mutation.applied(source))
        try:
            if path.suffix != ".py":
                built = subprocess.run([sys.executable, *BUILD], cwd=self.folder, capture_output=True, check=False)
                if built.returncode:
                    return "noticed by the compiler"
            places = sorted({test.partition("::")[0] for test in seconds})
            code = self._code_of_tests(places, Chosen(seconds), LONGEST * sum(seconds.values()) + 30) if places else 0
            if code in (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED):
                return f"SURVIVED {len(seconds)} tests"
            failed = re.search(r"^(?:FAILED|ERROR) (\S+)", (self.folder / OUTPUT).read_text(), re.MULTILINE)
            return f"noticed by {failed[1] if failed else f'the end of the process ({code})'}"
        finally:
            path.write_bytes(source)

    def _code_of_tests(
        self, told: Sequence[str], plugin: Chosen, limit_s: float, seconds_file: Path | None = None
    ) -> int:
        """Run pytest in a fork, which has the libraries already, and return its exit code."""
        child = os.fork()
        if not child:
            _run_tests(self.folder, told, plugin, limit_s, seconds_file)
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def _run_tests(
    folder: Path, told: Sequence[str], plugin: Chosen, limit_s: float, seconds_file: Path | None
) -> NoReturn:
    """Run pytest in this process, and end it. The limit is of processor time, which a busy machine does not lengthen;
    a test that waits for ever has pytest's timeout. Bytecode of a mutation is not kept: it would outlive the mutation.
    """
    code = 1
    try:
        resource.setrlimit(resource.RLIMIT_CPU, (int(limit_s), int(limit_s)))
        output = os.open(folder / OUTPUT, os.O_RDWR | os.O_CREAT | os.O_TRUNC)
        for standard in (0, 1, 2):
            os.dup2(output, standard)
        os.chdir(folder)
        sys.path[:] = [str(folder), *(place for place in sys.path if place not in ("", str(ROOT)))]
        for name in [name for name in sys.modules if name.partition(".")[0] in COPIED]:
            del sys.modules[name]
        os.environ["PYTHONPATH"] = str(folder)
        if seconds_file is not None:
            os.environ["COVERAGE_PROCESS_START"] = str(folder / "coverage.ini")
        else:
            os.environ["PYTHONDONTWRITEBYTECODE"] = "1"
            sys.dont_write_bytecode = True
        code = pytest.main([*OPTIONS, *told], plugins=[plugin])
        if seconds_file is not None:
            seconds_file.write_text(json.dumps(plugin.seconds))
    finally:
        os._exit(code)


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
    for name in LIBRARIES:  # which every fork would import
        importlib.import_module(name)
    with tempfile.TemporaryDirectory() as folder:
        tree = Tree(Path(folder), told.room)
        coverage = tree.coverage()
        survivors = 0
        for number, mutation in enumerate(chosen, 1):
            source = files[mutation.path]
            tests = coverage.tests_of(mutation, source)
            outcome = tree.outcome(mutation, {test: coverage.seconds[test] for test in tests})
            survivors += outcome.startswith("SURVIVED")
            print(f"{number}/{len(chosen)} {mutation.describe(source)}: {outcome}", flush=True)
    share = 1 - survivors / max(len(chosen), 1)
    print(f"{told.room}: {len(chosen) - survivors} of {len(chosen)} mutations noticed ({share:.0%})")
    return int(share < told.at_least)


if __name__ == "__main__":
    sys.exit(main())
