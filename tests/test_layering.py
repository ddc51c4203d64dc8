"""One direction of imports: sensor -> eyes -> optics -> content -> model -> panels, and only the top sees them all."""

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
