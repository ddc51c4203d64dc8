"""One direction of imports: every module has its room, every room its place, and nothing imports in a circle.

The stages do not know each other; evaluation, plan, frame, daemon and commands stand on them, in this order.
"""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
STAGES = {"sensor", "eyes", "content", "model", "panels"}
SHARED = {"records", "config", "clock", "errors", "support", "optics"}
FLOORS: tuple[tuple[str, ...], ...] = (  # from the ground up; what stands beside each other may be used by each other
    ("version", "errors", "clock", "records", "config", "support", "optics"),
    ("sensor", "eyes", "content", "model", "panels"),
    ("evaluation",),
    ("plan",),
    ("frame",),
    ("blackbox",),
    ("daemon",),
    ("report", "page", "commands", "cli"),
)
HEAVY = ("torch", "cv2", "onnxruntime", "scipy", "numpy")


def modules_of(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


def dotted(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports_of(path: Path) -> Iterator[tuple[str, int]]:
    """Every module that a file imports, at its top or inside a function, as an absolute dotted name and a line."""
    parts = dotted(path).split(".")
    package = parts if path.name == "__init__.py" else parts[:-1]
    yield from imports_in(path.read_text(encoding="utf-8"), package=package)


def imports_in(text: str, *, package: list[str]) -> Iterator[tuple[str, int]]:
    """The same of a source text that belongs to a package."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            # `from runtime import model` imports runtime.model: the names count too.
            yield from ((f"{base}.{alias.name}", node.lineno) for alias in node.names)


def part_of(name: str) -> str:
    """Which part of runtime a dotted name belongs to: `optics` of `runtime.optics.malus`."""
    return name.split(".")[1] if name.count(".") else ""


def broken(path: Path, allowed: set[str]) -> list[str]:
    """What a module of runtime imports from beyond the allowed parts, each with its place."""
    return [
        f"{path.relative_to(ROOT)}:{line} imports {name}"
        for name, line in imports_of(path)
        if name.split(".")[0] in {"model_export", "calib", "tests"}
        or (name.split(".")[0] == "runtime" and part_of(name) not in allowed)
    ]


def every_module() -> dict[str, Path]:
    """Dotted name and file of all of runtime."""
    return {dotted(path): path for path in modules_of("runtime")}


def imported_modules(name: str, modules: dict[str, Path]) -> set[str]:
    """The modules of runtime that one imports, anywhere in it."""
    found = set()
    for imported, _ in imports_of(modules[name]):
        while imported and imported not in modules:  # a name in a module
            imported = imported.rpartition(".")[0]
        found.add(imported)
    return found - {"", "runtime", name}


def room_of(name: str) -> str:
    """`frame` of `runtime.frame.solver`, `config` of `runtime.config`."""
    return [*name.split("."), ""][1]


def circles(edges: dict[str, set[str]]) -> list[list[str]]:
    """Groups of modules that import each other, by whatever way (Tarjan's strongly connected components)."""
    number: dict[str, int] = {}
    low: dict[str, int] = {}
    path: list[str] = []
    found: list[list[str]] = []

    def visit(node: str) -> None:
        number[node] = low[node] = len(number)
        path.append(node)
        for other in sorted(edges.get(node, ())):
            if other not in number:
                visit(other)
                low[node] = min(low[node], low[other])
            elif other in path:
                low[node] = min(low[node], number[other])
        if low[node] == number[node]:
            group = path[path.index(node) :]
            del path[path.index(node) :]
            if len(group) > 1:
                found.append(sorted(group))

    for node in sorted(edges):
        if node not in number:
            visit(node)
    return found


def test_every_module_belongs_to_a_room() -> None:
    rooms = {room for floor in FLOORS for room in floor}
    assert [name for name in every_module() if name != "runtime" and room_of(name) not in rooms] == []


def test_a_room_stands_on_those_below_it() -> None:
    floor_of = {room: number for number, floor in enumerate(FLOORS) for room in floor}
    modules = every_module()
    upwards = [
        f"{name} imports {imported}"
        for name in modules
        if name != "runtime"
        for imported in sorted(imported_modules(name, modules))
        if floor_of[room_of(imported)] > floor_of[room_of(name)]
    ]
    assert upwards == []


def test_nothing_imports_in_a_circle_not_even_inside_a_function() -> None:
    modules = every_module()
    assert circles({name: imported_modules(name, modules) for name in modules}) == []


def test_a_circle_is_found_wherever_it_is() -> None:
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"b", "d"}, "d": set()}) == [["b", "c"]]
    assert circles({"a": {"b", "c"}, "b": {"c"}, "c": set()}) == []


@pytest.mark.parametrize("stage", sorted(STAGES))
def test_a_stage_imports_only_what_is_shared_and_itself(stage: str) -> None:
    paths = modules_of(f"runtime/{stage}")
    assert paths, f"there is no stage {stage}"
    assert [line for path in paths for line in broken(path, SHARED | {stage})] == []


def test_optics_imports_only_records_and_itself() -> None:
    assert [line for path in modules_of("runtime/optics") for line in broken(path, {"records", "optics"})] == []


@pytest.mark.parametrize("module", ["records", "errors", "clock", "config", "support/artifacts", "support/gl"])
def test_what_all_share_depends_on_no_stage(module: str) -> None:
    assert broken(ROOT / "runtime" / f"{module}.py", SHARED) == []


def test_the_runtime_needs_neither_model_export_nor_calib_except_for_their_commands() -> None:
    for path in modules_of("runtime"):
        inside = path.relative_to(ROOT / "runtime")
        if inside.parts[0] in {"commands", "cli.py"}:
            continue
        roots = {name.split(".")[0] for name, _ in imports_of(path)}
        assert not roots & {"model_export", "calib", "torch", "onnx"}, path


@pytest.mark.parametrize("package", ["model_export", "calib"])
def test_the_tools_stand_on_the_runtime_and_not_on_each_other(package: str) -> None:
    other = {"model_export": "calib", "calib": "model_export"}[package]
    for path in modules_of(package):
        assert other not in {name.split(".")[0] for name, _ in imports_of(path)}, path


@pytest.mark.parametrize(
    "text",
    [
        "import runtime.model.predictor",
        "from runtime.model import predictor",
        "from runtime import model",
        "from ..model import predictor",
        "def f():\n    from runtime.model.predictor import load_predictor",
    ],
)
def test_no_way_of_reaching_another_stage_goes_unnoticed(text: str) -> None:
    names = [name for name, _ in imports_in(text, package=["runtime", "sensor"])]
    assert "model" in map(part_of, names)


def test_asking_for_help_loads_nothing_heavy() -> None:
    """`import runtime.commands.app` stays quick because none of these is loaded before a command needs it."""
    code = f"import sys, runtime.cli, runtime.commands.app; print(*[name for name in {HEAVY!r} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == []
