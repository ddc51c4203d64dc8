"""What the contracts of imports in pyproject.toml (`make lint`) can't say: no circles, and what a command may load."""

from __future__ import annotations

import graphlib
import subprocess
import sys
from pathlib import Path

import grimp
import pytest

ROOT = Path(__file__).resolve().parents[1]
HEAVY = ("torch", "onnx", "onnxruntime", "cv2", "scipy", "matplotlib", "moderngl", "numba", "numpy")


def circle(imports: dict[str, set[str]]) -> list[str]:
    """Modules that import each other, by whatever way, the first also last; empty: there are none."""
    try:
        graphlib.TopologicalSorter(imports).prepare()
    except graphlib.CycleError as error:
        return list(error.args[1])
    return []


def test_no_module_imports_in_a_circle_not_even_inside_a_function() -> None:
    graph = grimp.build_graph("runtime", "calib", "model_export")
    assert len(graph.modules) > 300
    assert circle({name: graph.find_modules_directly_imported_by(name) for name in graph.modules}) == []


def test_a_circle_is_found_wherever_it_is() -> None:
    assert sorted(set(circle({"a": {"b"}, "b": {"c"}, "c": {"b", "d"}, "d": set()}))) == ["b", "c"]
    assert circle({"a": {"b", "c"}, "b": {"c"}, "c": set()}) == []


def test_every_contract_of_imports_can_be_broken(tmp_path: Path) -> None:
    """An import against each, in a copy of the smallest kind: the linter names it."""
    for module, text in {
        "runtime/sensor/a.py": "def f():\n    from runtime.model import b",
        "runtime/model/b.py": "import torch",
        "runtime/optics/c.py": "import runtime.config",
        "runtime/config.py": "from runtime import frame",
        "runtime/frame/d.py": "",
        "calib/e.py": "import model_export.f",
        "model_export/f.py": "",
    }.items():
        path = tmp_path / module
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    rooms = {room for room in (ROOT / "runtime").iterdir() if (room / "__init__.py").is_file() or room.suffix == ".py"}
    for room in rooms:
        copy = tmp_path / "runtime" / room.name
        if room.is_dir():
            copy.mkdir(exist_ok=True)
            (copy / "__init__.py").touch()
        else:
            copy.touch()
    for package in ("calib", "model_export"):
        (tmp_path / package / "__init__.py").touch()
    done = subprocess.run(
        [Path(sys.executable).parent / "lint-imports", "--no-cache", "--config", ROOT / "pyproject.toml"],
        cwd=tmp_path, env={"PYTHONPATH": str(tmp_path)}, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 1, done.stdout
    assert "0 kept" in done.stdout, done.stdout


@pytest.mark.parametrize(
    ("arguments", "loads"),
    [
        (["--help"], ()),
        (["solve", "--help"], ()),
        (["config"], ("numpy",)),
        (["status", "--socket", "/nonexistent/s"], ()),
        (["ctl", "--socket", "/nonexistent/s", "pause"], ()),
        (
            ["run", "--replay", "demo", "--headless", "--max-speed", "--frames", "1", "--scale", "0.05"],
            ("numpy", "cv2", "onnxruntime", "moderngl", "numba", "scipy"),  # numba asks scipy for its BLAS
        ),
    ],
    ids=lambda value: " ".join(value[:2]) or "nothing",
)
def test_a_command_loads_nothing_heavy_that_it_does_not_use(arguments: list[str], loads: tuple[str, ...]) -> None:
    """A name that is missing here is as wrong as one too many: it says what a command needs."""
    code = (
        "import atexit, sys\n"
        f"atexit.register(lambda: print('loaded:', *[name for name in {HEAVY!r} if name in sys.modules]))\n"
        f"sys.argv = ['phasestack', *{arguments!r}]\n"
        "from runtime.cli import main\nmain()\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=120)
    (line,) = [line for line in done.stdout.splitlines() if line.startswith("loaded:")]
    assert set(line.split()[1:]) == set(loads), done.stderr
