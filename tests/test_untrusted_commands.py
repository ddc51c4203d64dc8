"""Tests that invalid files, paths and JSON as options give one line and exit code 2, without delay."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest
import typer.main

from runtime.commands.app import app
from runtime.errors import InputError
from tests.test_cli import refusal
from tests.test_docs import walk

HEADLESS = "run --headless --max-speed --frames 1 --scale 0.1 --out {out}"
EYES = "--left-eye 0.6 -0.03 0 --right-eye 0.6 0.03 0 --fov 40"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("fifo.png", "fifo.toml", "fifo.json", "fifo.mcap", "fifo.onnx", "fifo.csv", "fifo.pth"):
        os.mkfifo(tmp_path / name)
    rows = "0.1,0.1,0.6,0.6,0.1,0.2\n0.2,0.1,0.6,0.6,0.2,0.2\n0.1,0.3,0.7,0.7,0.1,0.4\n"
    (tmp_path / "good.csv").write_text("sensor_x,sensor_y,sensor_z,stack_x,stack_y,stack_z\n" + rows)
    (tmp_path / "deep.json").write_text("[" * 100_000)
    (tmp_path / "deep.toml").write_text("a = " + "[" * 100_000)
    return tmp_path


@pytest.mark.parametrize(
    ("command", "told"),
    [
        (f"{HEADLESS} --config {{folder}}/fifo.toml", "fifo.toml: is a FIFO"),
        (f"{HEADLESS} --config {{folder}}/deep.toml", "deep.toml: malformed: nested too deeply"),
        (f"{HEADLESS} --replay {{folder}}/fifo.mcap", "fifo.mcap: is a FIFO"),
        (f"{HEADLESS} --replay /dev/zero", "/dev/zero: is a device"),
        (f"{HEADLESS} --replay demo --scene {{folder}}/fifo.png", "fifo.png: is a FIFO"),
        (f"{HEADLESS} --replay demo --scene " + "x" * 5000, "5000 characters"),
        (f"{HEADLESS} --replay demo --model {{folder}}/fifo.onnx", "fifo.onnx: is a FIFO"),
        (
            f"solve --left {{folder}}/fifo.png --right {{folder}}/fifo.png {EYES} --panels {{folder}}/deep.json"
            " --out {out}",
            "fifo.png: is a FIFO",
        ),
        ("plan --config {folder}/deep.json", "deep.json: the JSON is nested more than 64"),
        ("calibrate solve --pairs {folder}/fifo.csv --out {out}/a.toml", "fifo.csv: is a FIFO"),
        ("calibrate solve --pairs {folder}/deep.json --out {out}/a.toml", "deep.json: the JSON is nested more than 64"),
        ("doctor --config {folder}/fifo.toml", "fifo.toml: is a FIFO"),
        ("status --config {folder}/fifo.toml", "fifo.toml: is a FIFO"),
        ("calibrate panels --photos {long} --out {out}", "File name too long"),
        ("calibrate capture --replay demo --out {long}.csv", "File name too long"),
        ("calibrate solve --pairs {folder}/good.csv --out {long}.toml", "File name too long"),
        ("identify --config {long}.toml", "File name too long"),
        ("record --motion walk --out {folder}/a.txt", "a.txt: --out: must end in .mcap"),
        ("report --out {folder}/good.csv", "good.csv: --out: is a file"),
        ("train --arch unrolled --out {folder}/good.csv", "good.csv: --out: is a file"),
    ],
)
@pytest.mark.timeout(60)
def test_it_is_refused_in_one_line(folder: Path, command: str, told: str) -> None:
    named = command.format(out=folder / "out", folder=folder, long=folder / ("d" * 300))
    assert told in refusal(*named.split())
    assert not (folder / "out").exists()


def parameters(kind: str) -> list[tuple[tuple[str, ...], Any]]:
    """Every option and argument of a kind, with its command's words."""
    found = walk(typer.main.get_command(app))
    return [(words, one) for words, command in found for one in command.params
            if kind in str(one.type_descriptor.annotation)]  # fmt: skip


@pytest.mark.parametrize("text", ["nan", "inf", "1e308"])
@pytest.mark.parametrize(("words", "parameter"), parameters("float"), ids=lambda x: " ".join(getattr(x, "opts", x)))
def test_every_number_is_refused_outside_its_range_by_its_option(
    words: tuple[str, ...], parameter: Any, text: str
) -> None:
    count = str(parameter.type_descriptor.annotation).count("float")
    given = [name for name in parameter.opts if name.startswith("-")]
    with pytest.raises(InputError, match=f"^{' '.join(words)}: {parameter.opts[0]}: "):
        app([*words, *given, *[text] * count])
