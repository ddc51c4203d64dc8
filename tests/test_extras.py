"""Tests that a missing optional package is reported in one line that names its extra."""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from runtime.support.extras import IMPORTED_AS

PYPROJECT = Path(__file__).resolve().parents[1] / "pyproject.toml"
MISSING = 'raise ModuleNotFoundError("No module named {package}", name="{package}")\n'


def of_extras() -> set[str]:
    """Modules of every package that only an extra brings, torch and its like included."""
    project = tomllib.loads(PYPROJECT.read_text())["project"]
    extras = {name: needed for name, needed in project["optional-dependencies"].items() if name not in ("test", "docs")}
    packages = {one.partition(">")[0].partition("[")[0] for needed in extras.values() for one in needed}
    module = {package: name for name, package in IMPORTED_AS.items()}
    return {module.get(package, package).replace("-", "_") for package in packages - {"phasestack"}}


def without(*packages: str, folder: Path, command: list[str]) -> subprocess.CompletedProcess[str]:
    """Run a command, with all its processes, as if these packages were not there when they are imported."""
    for package in packages:
        (folder / "shadow" / package).mkdir(parents=True)
        (folder / "shadow" / package / "__init__.py").write_text(MISSING.format(package=package))
    environment = os.environ | {"PYTHONPATH": f"{folder / 'shadow'}:{PYPROJECT.parent}"}
    command = [sys.executable, "-m", "runtime.cli", *command]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=120)


@pytest.mark.parametrize(
    ("command", "package", "extra"),
    [
        (["demo"], "moderngl", "content"),
        (["run", "--replay", "demo", "--headless"], "mcap", "sensors"),
        (["run", "--replay", "demo", "--headless", "--max-speed"], "mcap", "sensors"),
        (["record", "--out", "x.mcap"], "openni", "sensors"),
        (["page"], "uvicorn", "service"),
        (["stability"], "scipy", "content"),
        (["identify"], "glfw", "display"),
        (["train", "--arch", "eyereal", "--out", "out"], "torch", "export"),
    ],
)
def test_a_command_names_the_extra_that_it_needs(tmp_path: Path, command: list[str], package: str, extra: str) -> None:
    if command[0] == "record":
        (tmp_path / "openni2.toml").write_text('[sensor]\ndriver = "openni2"\n')
        command = [*command, "--config", "openni2.toml"]
    done = without(package, folder=tmp_path, command=command)
    told = f"phasestack: {package} is not installed; run: pip install 'phasestack[{extra}]'"
    assert done.returncode == 2 and told in done.stderr.splitlines()  # a log's thread may write after it
    assert "Traceback" not in done.stderr and "unexpected" not in done.stderr


def test_the_doctor_lists_what_is_not_installed_and_goes_on(tmp_path: Path) -> None:
    done = without("moderngl", "usb", folder=tmp_path, command=["doctor"])
    assert done.returncode == 1
    assert "fail  opengl: moderngl is not installed; run: pip install 'phasestack[content]'" in done.stdout
    assert "skip  usb: pyusb is not installed; run: pip install 'phasestack[sensors]'" in done.stdout
    assert "service:" in done.stdout
