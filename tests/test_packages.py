"""Tests that wheel and sdist contain everything that a clean machine needs, and nothing else."""

from __future__ import annotations

import os
import subprocess
import sys
import tarfile
import venv
import zipfile
from fnmatch import fnmatch
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
DEMO_FILES = {"contact-sheet.png", "layer-0.png", "layer-1.png", "layer-2.png", "frames.jsonl", "summary.json"}

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]


def done(*command: str | Path, cwd: Path) -> str:
    """Output of a command run outside this checkout."""
    environment = {name: value for name, value in os.environ.items() if name not in {"PYTHONPATH", "VIRTUAL_ENV"}}
    result = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=1500)
    assert result.returncode == 0, result.stderr[-2000:]
    return result.stdout


@pytest.fixture(scope="module")
def packages(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with both, made of the files that git knows as they are here."""
    folder = tmp_path_factory.mktemp("packages")
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in filter(None, listed.split("\0")):
        if (ROOT / name).is_file():
            (folder / "source" / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / "source" / name).write_bytes((ROOT / name).read_bytes())
    done(sys.executable, "-m", "build", "--outdir", folder / "dist", cwd=folder / "source")
    return folder / "dist"


def test_the_wheel_holds_every_file_of_the_packages_and_the_sdist_too(packages: Path) -> None:
    (wheel,), (sdist,) = packages.glob("*.whl"), packages.glob("*.tar.gz")
    in_wheel = set(zipfile.ZipFile(wheel).namelist())
    with tarfile.open(sdist) as archive:
        in_sdist = {name.partition("/")[2] for name in archive.getnames()}
    wanted = {
        str(path.relative_to(ROOT))
        for package in ("phasestack", "runtime", "calib", "model_export")
        for path in (ROOT / package).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts and path.suffix != ".so"
    }
    assert len(wanted) > 300
    assert wanted - in_wheel == set()
    assert wanted - in_sdist == set()
    assert [name for name in in_wheel if fnmatch(name, "runtime/kernels/compiled*.so")]
    assert not [name for name in in_wheel if name.startswith(("tests/", "docs/"))]


# Promises of docs/contracts.md to programs.
PROGRAM = """
import numpy, phasestack, runtime
left = numpy.random.default_rng(0).integers(0, 256, (108, 192, 3)).astype("uint8").repeat(10, 0).repeat(10, 1)
stack = phasestack.Stack(width_m=0.5184, height_m=0.2916, x_m=(-0.06, 0.0, 0.06), width_px=1920, height_px=1080)
eyes_m = ((0.78, -0.03, 0.24), (0.78, 0.03, 0.24))
result = phasestack.solve(left, left, eyes_m=eyes_m, stack=stack, fov_deg=40, model="balanced", eye_sigma_mm=1.0)
result.save("out")
print(numpy.__version__, runtime.__file__)
"""


def test_the_wheel_alone_runs_a_program_and_with_its_extras_the_demo(packages: Path, tmp_path: Path) -> None:
    """In a clean environment, with the newest that the ranges allow: what `pip install` gives to anybody."""
    venv.create(tmp_path / "clean", with_pip=True)
    python = tmp_path / "clean" / "bin" / "python"
    (wheel,) = packages.glob("*.whl")
    done(python, "-m", "pip", "install", "-q", "numpy<2.3", wheel, cwd=tmp_path)
    version, where = done(python, "-c", PROGRAM, cwd=tmp_path).split()
    assert version < "2.3" and where.startswith(str(tmp_path))
    assert (tmp_path / "out" / "contact-sheet.png").stat().st_size > 10_000
    command = tmp_path / "clean" / "bin" / "phasestack"
    refused = subprocess.run([command, "demo"], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert refused.returncode == 2 and "pip install 'phasestack[content]'" in refused.stderr
    done(python, "-m", "pip", "install", "-q", f"{wheel}[all]", cwd=tmp_path)
    done(command, "demo", "--frames", "12", "--out", "demo", cwd=tmp_path)
    assert {path.name for path in (tmp_path / "demo").iterdir()} >= DEMO_FILES
