"""Tests `scene = "pipe"` with real pipes and processes."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from runtime.config import ContentSettings, StackGeometry
from runtime.content import live, pipe
from runtime.content.registry import open_content
from runtime.errors import ContentFailure, InputError
from runtime.plan.drawing import raster_views
from tests.waiting import eventually

STACK = replace(StackGeometry().stack(), width_px=64, height_px=36)
EYES = np.array([[0.6, -0.03, 0.0], [0.6, 0.03, 0.0]])


def opened(**options: Any) -> Any:
    layout = options.pop("layout", "half-side-by-side")
    return open_content(ContentSettings(scene="pipe", layout=layout, options=options), STACK, None)


@pytest.fixture
def fifo(tmp_path: Path) -> Path:
    os.mkfifo(tmp_path / "video")
    return tmp_path / "video"


def y4m(values: tuple[int, ...], *, width: int = 64, height: int = 36, colours: str = "444") -> bytes:
    """Pictures whose left half has each of the values, and whose right half is 20 brighter. Both are grey."""
    data = f"YUV4MPEG2 W{width} H{height} F30:1 Ip A1:1 C{colours}\n".encode()
    for value in values:
        luma = np.full((height, width), value, np.uint8)
        luma[:, width // 2 :] += 20
        chroma = {"444": width * height, "422": (width + 1) // 2 * height, "mono": 0}
        size = chroma.get(colours, (width + 1) // 2 * ((height + 1) // 2))
        data += b"FRAME\n" + luma.tobytes() + bytes([128]) * (2 * size)
    return data


def grey_of(luma: int) -> float:
    return (luma - 16) * 255 / 219


def drawn(source: Any) -> list[np.ndarray]:
    views = raster_views(EYES, STACK.panel(1))
    source.expect(views, time_ns=0)
    return [source.render(view, time_ns=0).copy() for view in views]


def shows(source: Any, luma: int, *, is_full: bool = False) -> bool:
    try:
        left, right = drawn(source)
    except ContentFailure:
        return False
    return all(
        np.abs(picture[18, 32, :3].astype(float) - (value if is_full else grey_of(value))).max() < 3
        for picture, value in ((left, luma), (right, luma + 20))
    )


@pytest.mark.parametrize("colours", ["444", "420jpeg", "420mpeg2", "420", "420 XCOLORRANGE=FULL", "422", "mono"])
def test_each_eye_sees_its_half_of_the_newest_picture(fifo: Path, colours: str) -> None:
    source = opened(path=str(fifo))
    with pytest.raises(ContentFailure, match="waiting for"):
        drawn(source)
    with fifo.open("wb") as writer:
        writer.write(y4m((50, 90, 130), width=66, height=37, colours=colours))
        writer.flush()
        assert eventually(lambda: shows(source, 130, is_full=colours in ("mono", "420 XCOLORRANGE=FULL")))
        assert source.problem == "" and source.revision(time_ns=0) == 3
    source.close()


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="needs FFmpeg")
def test_ffmpeg_writes_to_a_pipe_and_is_started_again() -> None:
    halves = "color=gray:s=32x36,format=gray,geq=lum=60[l];color=gray:s=32x36,format=gray,geq=lum=80[r];[l][r]hstack"
    command = ["ffmpeg", "-v", "error", "-re", "-f", "lavfi", "-i", halves, "-pix_fmt", "gray", "-t", "0.4"]
    source = opened(command=[*command, "-f", "yuv4mpegpipe", "-strict", "-1", "-"])
    assert eventually(lambda: shows(source, 60, is_full=True) and source.problem == "")
    assert eventually(lambda: source.problem.endswith("ffmpeg: closed"))
    before = source.revision(time_ns=0)
    assert eventually(lambda: source.revision(time_ns=0) > before and source.problem == "")
    source.close()


def test_raw_rgb_needs_its_size(fifo: Path) -> None:
    source = opened(path=str(fifo), rgb_size=(64, 36), layout="mono")
    with fifo.open("wb") as writer:
        writer.write(bytes([10, 200, 30]) * (64 * 36))
        writer.flush()
        assert eventually(lambda: source.revision(time_ns=0) == 1)
        assert drawn(source)[1][18, 32, :3].tolist() == [10, 200, 30]
    source.close()


def test_a_closed_pipe_is_told_and_comes_back_in_another_size(fifo: Path) -> None:
    source = opened(path=str(fifo))
    with fifo.open("wb") as writer:
        writer.write(y4m((50,)))
    assert eventually(lambda: source.revision(time_ns=0) == 1 and source.problem.endswith("closed"))
    assert shows(source, 50)  # the last picture stays
    with fifo.open("wb") as writer:
        writer.write(y4m((90,), width=128, height=72))
        writer.flush()
        assert eventually(lambda: shows(source, 90)) and source.problem == ""
    source.close()


def test_a_frozen_pipe_is_told(fifo: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "FROZEN_S", 0.2)
    source = opened(path=str(fifo))
    with fifo.open("wb") as writer:
        writer.write(y4m((50,)))
        writer.flush()
        assert eventually(lambda: "no new picture for" in source.problem)
        writer.write(y4m((70,)).partition(b"\n")[2])
        writer.flush()
        assert eventually(lambda: source.problem == "")
    source.close()


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"x" * 2000, "neither Y4M nor"),
        (b"YUV4MPEG2 W0 H36 C420\n" + b"x" * 2000, "neither Y4M nor"),
        (y4m((50,), width=128, height=128), "pictures of 128 x 128 pixels cannot be shown"),
        (y4m((50,)) + b"frame\n" * 20, "neither Y4M nor"),
    ],
)
def test_other_data_is_told(fifo: Path, data: bytes, why: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pipe, "FRAME_MAX_BYTES", 3 * 127 * 128)
    source = opened(path=str(fifo))
    reasons = []
    with fifo.open("wb", buffering=0) as writer:
        writer.write(data)
        assert eventually(lambda: reasons.append(source.problem) or any(why in reason for reason in reasons))
    source.close()


@pytest.fixture
def writer(tmp_path: Path) -> Iterator[list[str]]:
    """A command that writes its process number to a file, and then a picture every 10 ms."""
    (tmp_path / "y4m").write_bytes(y4m((60, 60)))
    yield [
        sys.executable,
        "-c",
        "import os, sys, time; p = sys.argv[1]; open(p + '/pid', 'w').write(str(os.getpid()))\n"
        "head, mark, frame = open(p + '/y4m', 'rb').read().rpartition(b'FRAME')\n"
        "sys.stdout.buffer.write(head)\n"
        "while True: sys.stdout.buffer.write(mark + frame); sys.stdout.buffer.flush(); time.sleep(0.01)",
        str(tmp_path),
    ]


def test_a_command_is_started_again_and_ends_with_the_scene(writer: list[str], tmp_path: Path) -> None:
    source = opened(command=writer)
    assert eventually(lambda: shows(source, 60))
    first = int((tmp_path / "pid").read_text())
    os.kill(first, 9)
    assert eventually(lambda: (tmp_path / "pid").read_text() not in ("", str(first)) and source.problem == "")
    assert shows(source, 60)
    last = int((tmp_path / "pid").read_text())
    source.close()
    assert eventually(lambda: not Path(f"/proc/{last}").exists())


def test_a_command_that_fails_is_told() -> None:
    source = opened(command=["false"])
    assert eventually(lambda: source.problem == "false: ended with exit status 1")
    source.close()
    missing = opened(command=["/nowhere/ffmpeg"])
    assert eventually(lambda: "No such file" in missing.problem)
    missing.close()


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ({}, "set either path or command"),
        ({"path": "a", "command": ["b"]}, "set either path or command"),
        ({"path": "/nowhere/video"}, "does not exist; create it with `mkfifo"),
        ({"path": "/etc/hostname"}, "is not a pipe"),
    ],
)
def test_wrong_options_are_one_line(options: dict, why: str) -> None:
    with pytest.raises(InputError, match=why):
        opened(**options)
