"""Tests on a virtual X server that `doctor` reports monitors that change the panels' pictures."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from tests.panels.xserver import HEIGHT_PX, WIDTH_PX, XServer

CONFIGURATION = f"""
[stack]
width_px = {WIDTH_PX}
height_px = {HEIGHT_PX}
[output]
kind = "windows"
panels = [{{ connector = "DUMMY0" }}, {{ connector = "DUMMY1" }}, {{ connector = "DUMMY2" }}]
"""
LOOK = (
    "import json, sys\n"
    "from pathlib import Path\n"
    "from runtime.commands.doctor import monitors\n"
    "from runtime.config import load_settings\n"
    "print(json.dumps([[row.state, row.detail] for row in monitors(load_settings(Path(sys.argv[1])))]))\n"
)


def rows(folder: Path) -> list[Any]:
    """The doctor's verdict and finding for each monitor and panel."""
    (folder / "a.toml").write_text(CONFIGURATION)
    done = subprocess.run(
        [sys.executable, "-c", LOOK, str(folder / "a.toml")], capture_output=True, text=True, env=os.environ
    )
    assert done.returncode == 0, done.stderr
    return list(json.loads(done.stdout))


def test_a_gamma_set_by_the_x_server_is_found(x: XServer, tmp_path: Path) -> None:
    assert {state for state, _ in rows(tmp_path)} == {"ok"}
    x.xrandr("--output", "DUMMY1", "--gamma", "1:0.8:0.6")
    try:
        warned = [detail for state, detail in rows(tmp_path) if state == "warn"]
        assert len(warned) == 1 and "grey levels of DUMMY1 (gamma, brightness or a night light)" in warned[0]
        x.xrandr("--output", "DUMMY1", "--gamma", "1:1:1", "--brightness", "1")
        assert {state for state, _ in rows(tmp_path)} == {"ok"}
    finally:
        x.xrandr("--output", "DUMMY1", "--gamma", "1:1:1", "--brightness", "1")


def test_monitors_mirrored_on_each_other_are_refused(x: XServer, tmp_path: Path) -> None:
    x.xrandr("--output", "DUMMY2", "--same-as", "DUMMY1")
    failed = [detail for state, detail in rows(tmp_path) if state == "fail"]
    assert len(failed) == 1 and failed[0].startswith("panels 1 and 2 would show the same pixels")
