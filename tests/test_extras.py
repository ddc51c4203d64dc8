"""Tests that a missing optional package is reported in one line that names its extra."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from runtime.support.extras import IMPORTED_AS

PYPROJECT = Path(__file__).resolve().parents[1] / "pyproject.toml"
BLOCKED = "import sys\nsys.modules.update(dict.fromkeys({packages}))\n"  # as if they were not there, when imported
MAIN = "from runtime.cli import main\nmain()\n"


def of_extras() -> set[str]:
    """Modules of every package that only an extra brings, torch and its like included."""
    project = tomllib.loads(PYPROJECT.read_text())["project"]
    extras = {name: needed for name, needed in project["optional-dependencies"].items() if name not in ("test", "docs")}
    packages = {one.partition(">")[0].partition("[")[0] for needed in extras.values() for one in needed}
    module = {package: name for name, package in IMPORTED_AS.items()}
    return {module.get(package, package).replace("-", "_") for package in packages - {"phasestack"}}


def without(*packages: str, command: list[str]) -> subprocess.CompletedProcess[str]:
    code = BLOCKED.format(packages=packages) + MAIN
    return subprocess.run([sys.executable, "-c", code, *command], capture_output=True, text=True, timeout=120)


@pytest.mark.parametrize(
    ("command", "package", "extra"),
    [
        (["demo"], "moderngl", "content"),
        (["demo"], "scipy", "content"),
        (["run", "--replay", "demo", "--headless"], "mcap", "sensors"),
        (["run", "--replay", "demo", "--headless", "--max-speed"], "mcap", "sensors"),
        (["record", "--out", "x.mcap"], "openni", "sensors"),
        (["page"], "uvicorn", "service"),
        (["stability"], "scipy", "content"),
        (["identify"], "glfw", "display"),
        (["train", "--arch", "eyereal", "--out", "out"], "torch", "export"),
    ],
)
def test_a_command_names_the_extra_that_it_needs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: list[str], package: str, extra: str
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(PYPROJECT.parent))
    if command[0] == "record":
        (tmp_path / "openni2.toml").write_text('[sensor]\ndriver = "openni2"\n')
        command = [*command, "--config", "openni2.toml"]
    done = without(package, command=command)
    told = f"phasestack: {package} is not installed; run: pip install 'phasestack[{extra}]'"
    assert done.returncode == 2 and told in done.stderr.splitlines()  # a log's thread may write after it
    assert "Traceback" not in done.stderr and "unexpected" not in done.stderr


def test_the_doctor_lists_what_is_not_installed_and_goes_on() -> None:
    done = without("moderngl", "usb", command=["doctor"])
    assert done.returncode == 1
    assert "fail  opengl: moderngl is not installed; run: pip install 'phasestack[content]'" in done.stdout
    assert "skip  usb: pyusb is not installed; run: pip install 'phasestack[sensors]'" in done.stdout
    assert "service:" in done.stdout
