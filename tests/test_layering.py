"""Tests import rules that pyproject.toml cannot express: no cycles, and limits for each command."""

from __future__ import annotations

import ast
import graphlib
import subprocess
import sys
from pathlib import Path

import grimp
import pytest

ROOT = Path(__file__).resolve().parents[1]
HEAVY = ("torch", "onnx", "onnxruntime", "cv2", "scipy", "matplotlib", "moderngl", "numpy")


def circle(imports: dict[str, set[str]]) -> list[str]:
    """Cycle of imports, the first module also last; empty: none."""
    try:
        graphlib.TopologicalSorter(imports).prepare()
    except graphlib.CycleError as error:
        return list(error.args[1])
    return []


def test_no_module_imports_in_a_circle_not_even_inside_a_function() -> None:
    graph = grimp.build_graph("runtime", "calib", "model_export")
    assert len(graph.modules) > 250
    assert circle({name: graph.find_modules_directly_imported_by(name) for name in graph.modules}) == []


@pytest.mark.parametrize(
    ("arguments", "loads"),
    [
        (["--help"], ()),
        (["solve", "--help"], ()),
        (["config"], ("numpy",)),
        (["status"], ()),
        (["ctl", "pause"], ()),
        (
            ["run", "--replay", "demo", "--headless", "--max-speed", "--frames", "1", "--scale", "0.05"],
            ("numpy", "cv2", "onnxruntime", "moderngl"),
        ),
    ],
    ids=lambda value: " ".join(value[:2]) or "nothing",
)
def test_a_command_loads_nothing_heavy_that_it_does_not_use(arguments: list[str], loads: tuple[str, ...]) -> None:
    """A missing name is as wrong as an extra one: the list is a command's needs."""
    code = (
        "import atexit, sys\n"
        f"atexit.register(lambda: print('loaded:', *[name for name in {HEAVY!r} if name in sys.modules]))\n"
        f"sys.argv = ['phasestack', *{arguments!r}]\n"
        "from runtime.cli import main\nmain()\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=120)
    (line,) = [line for line in done.stdout.splitlines() if line.startswith("loaded:")]
    assert set(line.split()[1:]) == set(loads), done.stderr


def test_a_public_class_name_is_in_one_module() -> None:
    modules: dict[str, set[str]] = {}
    for package in ("phasestack", "runtime", "calib", "model_export"):
        for path in (ROOT / package).rglob("*.py"):
            for node in ast.parse(path.read_text(encoding="utf-8")).body:
                if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                    modules.setdefault(node.name, set()).add(str(path.relative_to(ROOT)))
    shared = {name: paths for name, paths in modules.items() if len(paths) > 1}
    assert len(modules) > 250 and not shared, shared
