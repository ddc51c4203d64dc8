"""Tests a custom scene in one file and one line of TOML, and how wrong ones are refused."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from runtime.config import load_settings
from runtime.content.registry import open_content
from tests.calls import refusal
from tests.content.conftest import STACK

ROOT = Path(__file__).resolve().parents[2]
RUN = "run --config own.toml --replay demo --headless --max-speed --frames 4 --scale 0.1 --out out --json"


def run(folder: Path, content: str) -> subprocess.CompletedProcess[str]:
    (folder / "own.toml").write_text(f"[content]\n{content}\n")
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(folder), str(ROOT)])}
    command = [sys.executable, "-m", "runtime.cli", *RUN.split()]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=200)


def test_the_example_is_shown_from_a_folder_of_its_own(tmp_path: Path) -> None:
    shutil.copy(ROOT / "examples" / "tunnel.py", tmp_path)
    done = run(tmp_path, 'scene = "tunnel:Tunnel"\noptions = { radius_m = 0.1 }')
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["scene"] == "Tunnel"
    seen = [np.asarray(Image.open(tmp_path / "out" / f"wanted-{side}.png")).astype(float) for side in ("left", "right")]
    assert min(picture.std() for picture in seen) > 20 and np.abs(seen[0] - seen[1]).mean() > 2


@pytest.mark.parametrize(
    ("code", "content", "told"),
    [
        ("", 'scene = "tunnel:Tunnel"\noptions = { radius_m = 9 }', "content.options: radius_m: "),
        ("", 'scene = "gone:Tunnel"', "content.scene: `gone` cannot be imported: "),
        ("", 'scene = "json:JSONDecoder"', "`json:JSONDecoder` is not a class derived from phasestack.ContentSource"),
        ("return 1 / 0", 'scene = "own:Own"', "own:Own: ZeroDivisionError: division by zero in {folder}/own.py:"),
        ("return self", 'scene = "own:Own"', "own:Own: render: must return a uint8 RGBA array of shape (height_px, "),
        ("", 'scene = "own:Other"', "own:Other: render: must be declared as render(self, view, *, time_ns): "),
    ],
)
def test_a_wrong_one_is_one_line(
    tmp_path: Path, context: Any, monkeypatch: pytest.MonkeyPatch, code: str, content: str, told: str
) -> None:
    shutil.copy(ROOT / "examples" / "tunnel.py", tmp_path)
    text = "from phasestack import ContentSource\n\n\nclass Own(ContentSource):\n"
    text += f"    def render(self, view, *, time_ns):\n        {code or 'pass'}\n\n\nclass Other(Own):\n"
    (tmp_path / "own.py").write_text(f"{text}    def render(self, eye, view): ...\n")
    (tmp_path / "own.toml").write_text(f"[content]\n{content}\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))  # where the whole of an unexpected error is written
    for name in ("own", "tunnel"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    settings = load_settings(tmp_path / "own.toml").content
    assert told.replace("{folder}", str(tmp_path)) in refusal(open_content, settings, STACK, context)
