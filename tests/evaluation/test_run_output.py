"""Tests the files of a run, and what happens if the disk fails."""

from __future__ import annotations

import base64
import errno
import json
import os
import re
import subprocess
import threading
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from runtime.evaluation import contact_sheet, run_output
from runtime.evaluation.displayed import displayed
from runtime.evaluation.run_output import RunOutput
from runtime.optics.stack import PanelStack
from runtime.records import State
from runtime.support.picture_file import read_image

STACK = PanelStack(0.5, 0.3, (-0.06, 0.0, 0.06), 32, 18)
EYES = np.array([[0.7, -0.03, 0.05], [0.7, 0.03, 0.05]])
SUMMARY = {"presented": 3, "frames": 3, "model": "balanced", "provider": "cpu", "psnr_db": 30.0, "ssim": 0.9}

LIVE = {
    "light_db": 31.0,
    "quality_frames": 2,
    "live_db": 22.34,
    "live_frames": 3,
    "view_error_mm": {"p50": 4, "p95": 9},
}


def line(frame: int, **more: Any) -> dict[str, Any]:
    """A refresh as a presenter reports it."""
    return {"frame": frame, "eyes_m": EYES, "state": State.TRACKING, "true_eyes_m": None} | more


def pictures(seed: int = 0) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    rng = np.random.default_rng(seed)
    layers = rng.integers(0, 256, (3, 18, 32, 4), dtype=np.uint8)
    left, right = rng.integers(0, 256, (2, 18, 32, 3), dtype=np.uint8)
    return layers, (left, right)


def test_the_sheet_shows_the_moment_with_the_one_figure_to_quote(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[str] = []
    monkeypatch.setattr(contact_sheet, "_write", lambda sheet, text, **_: written.append(text))
    layers, wanted = pictures()
    look = displayed(layers, wanted, STACK, eyes_m=EYES, fov_deg=40)
    solution, solved_for_m = pictures(2)[0], EYES + np.array([0.0, 0.01, 0.0])
    lines = ("This moment",)
    moment = contact_sheet.Moment(pictures(1)[0], look, 33.25, lines, solution, solved_for_m, pictures(2)[1])
    with RunOutput(tmp_path) as output:
        output.finish(SUMMARY | LIVE, layers, moment)
    assert written[0] == "PSNR 33.2 dB at the eyes (pixels as squares, pupil 4 mm, tracking error 1 mm)"
    assert "This moment" in written
    whole = " ".join(written)  # long lines are wrapped
    assert "while the head moved, the live PSNR at the true eyes was 22.3 dB, including delays" in whole
    assert len(re.findall(r"\d dB", whole)) == 2  # this refresh's, and the run's
    np.testing.assert_array_equal(read_image(tmp_path / "layer-0.png"), layers[0, ..., :3])  # the last frame's
    page = (tmp_path / "viewer.html").read_text(encoding="utf-8")
    scene, urls = (json.loads(re.findall(rf'id="{name}">(.*?)</script>', page)[0]) for name in ("scene", "layers"))
    assert scene["eyes_m"] == solved_for_m.tolist()  # the page aligns by itself, from where it was solved for
    decoded = cv2.imdecode(np.frombuffer(base64.b64decode(urls[1].partition(",")[2]), np.uint8), cv2.IMREAD_COLOR_RGB)
    np.testing.assert_array_equal(decoded, solution[1, ..., :3])


class FullDisk:
    """A file on a disk that is full in the middle of its fourth line."""

    def __init__(self, file: Any) -> None:
        self.file, self.tried = file, 0

    def write(self, text: str) -> None:
        self.tried += 1
        self.file.write(text if self.tried < 4 else text[:9])
        if self.tried >= 4:
            self.close()

    def close(self) -> None:
        self.file.close()
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_full_disk_keeps_what_was_complete_and_the_run_goes_on(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    disks, opened = [], Path.open

    def on_a_full_disk(path: Path, *mode: Any, **rest: Any) -> Any:
        file = opened(path, *mode, **rest)
        if path.name != "frames.jsonl" or mode != ("w",):
            return file
        disks.append(FullDisk(file))
        return disks[0]

    monkeypatch.setattr(Path, "open", on_a_full_disk)
    layers, drawn = pictures()
    with RunOutput(tmp_path) as output:
        output.light(0, layers=layers)
        for frame in range(200):
            output.refresh(line(frame))
        for frame in range(3 * run_output.WAITING_PICTURES):  # none of them waits for a disk that has failed
            output.light(frame, layers=layers)
            output.light_targets(frame, drawn=drawn, true=drawn, info={})
        output.finish(SUMMARY, layers)
    assert "No space left" in output.problem
    assert len([record for record in caplog.records if "stopped writing" in record.message]) == 1
    assert disks[0].tried == 4
    assert sorted(path.name for path in tmp_path.rglob("*") if path.is_file()) == [
        "frames.jsonl", "layer-0.png", "layer-1.png", "layer-2.png", "summary.json",
    ]  # fmt: skip
    assert [json.loads(text)["frame"] for text in (tmp_path / "frames.jsonl").read_text().splitlines()] == [0, 1, 2]
    assert json.loads((tmp_path / "summary.json").read_text()) == SUMMARY


def test_pictures_without_room_on_the_disk_are_not_left_in_part(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, room = run_output.write_png, iter(range(7))

    def write(path: Path, image: np.ndarray) -> None:
        if next(room, None) is None:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        real(path, image)

    monkeypatch.setattr(run_output, "write_png", write)
    layers, drawn = pictures()
    with RunOutput(tmp_path) as output:
        for frame in range(2):
            output.light(frame, layers=layers)
        output.light_targets(0, drawn=drawn, true=drawn, info={})
        output.finish(SUMMARY, layers)
    kept = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*") if path.is_file()}
    assert kept == {"frames.jsonl", "summary.json"} | {f"light/{f}/layer-{n}.png" for f in range(2) for n in range(3)}


def test_a_disk_that_is_really_full_still_has_room_for_the_summary(tmp_path: Path) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=512k", "none", disk], capture_output=True).returncode:
        pytest.skip("only root can mount a small disk")
    try:
        with RunOutput(disk / "out") as output:
            for frame in range(4000):
                output.refresh(line(frame, reason="x" * 100))
            output.finish(SUMMARY, None)
        assert "No space left" in output.problem
        lines = (disk / "out/frames.jsonl").read_text().splitlines()
        assert [json.loads(text)["frame"] for text in lines] == list(range(len(lines))) and len(lines) > 100
        assert json.loads((disk / "out/summary.json").read_text()) == SUMMARY
    finally:
        subprocess.run(["umount", disk], check=True)


def test_where_lines_may_be_dropped_a_slow_disk_delays_nobody(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    go_on, layers = threading.Event(), pictures()[0]
    monkeypatch.setattr(run_output, "write_png", lambda *_: go_on.wait(60.0))
    with RunOutput(tmp_path, every_one=False) as output:
        output.light(0, layers=layers)
        for frame in range(run_output.WAITING + 50):
            output.refresh(line(frame))
        assert output.left_out >= 49
        go_on.set()
    assert output.problem == ""
    assert len((tmp_path / "frames.jsonl").read_text().splitlines()) <= run_output.WAITING + 1


def test_few_pictures_wait_for_a_slow_disk_until_the_run_is_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    go_on, layers, most = threading.Event(), pictures()[0], run_output.WAITING_PICTURES
    real = run_output.write_png
    monkeypatch.setattr(run_output, "write_png", lambda *what: (go_on.wait(60.0), real(*what)))
    with RunOutput(tmp_path, every_one=False) as output:
        for frame in range(most + 5):
            output.light(frame, layers=layers)
        assert output.left_out == 5
        go_on.set()
        output.run_is_over()
        for frame in range(100, 110):
            output.light(frame, layers=layers)
    assert len(list((tmp_path / "light").iterdir())) == most + 10 and output.left_out == 5


def test_an_error_of_the_run_itself_leaves_nothing_new(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError), RunOutput(tmp_path / "out") as output:
        output.refresh(line(0))
        raise RuntimeError
    assert not (tmp_path / "out").exists()
