"""A recorded run, end to end: production code with a replayed sensor, a simulated clock and offscreen panels."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from runtime.support.artifacts import read_image
from tests.test_cli import phasestack

FRAMES = 40
LAYERS = ("layer-0.png", "layer-1.png", "layer-2.png")


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The same run, twice."""
    folders = tuple(tmp_path_factory.mktemp("runs") / name for name in ("a", "b"))
    for folder in folders:
        arguments = ("--replay", "demo", "--headless", "--max-speed", "--frames", str(FRAMES), "--scale", "0.2")
        result = phasestack("run", *arguments, "--out", folder)
        assert result.returncode == 0, result.stderr
    return folders[0], folders[1]


def test_two_runs_at_full_speed_are_identical_to_the_byte(runs: tuple[Path, Path]) -> None:
    for name in (*LAYERS, "frames.jsonl", "seen-left.png", "seen-right.png", "wanted-left.png", "wanted-right.png"):
        assert digest(runs[0] / name) == digest(runs[1] / name), name


def test_every_sample_gets_a_turn_and_every_turn_is_presented(runs: tuple[Path, Path]) -> None:
    summary = json.loads((runs[0] / "summary.json").read_text())
    assert summary["frames"] == summary["presented"] == FRAMES
    assert summary["dropped"] == summary["stale_inputs"] == 0
    assert summary["inferences"] > FRAMES / 2
    assert summary["psnr_db"] > 20
    assert set(summary["stage_ms"]) == {
        "sensor", "track", "render", "prepare", "inference", "finish", "present", "wait",
    }  # fmt: skip


def test_frames_tell_where_the_eyes_were_predicted_and_for_when(runs: tuple[Path, Path]) -> None:
    frames = [json.loads(line) for line in (runs[0] / "frames.jsonl").read_text().splitlines()]
    assert [frame["frame"] for frame in frames] == list(range(FRAMES))
    for frame in frames:
        assert frame["predicted_for_ns"] > frame["capture_ns"]
        assert np.shape(frame["eyes_m"]) == (2, 3)
        assert frame["eyes_label"] in {"predicted", "held"}
    # What the loop expects a turn to take is what turns take: the simulated clock's stages.
    errors_ms = [(frame["predicted_for_ns"] - frame["present_ns"]) / 1e6 for frame in frames[5:]]
    assert np.abs(np.median(errors_ms) - 8.0) < 2.0  # the configured scan-out


def test_the_layers_are_pictures_of_the_stack(runs: tuple[Path, Path]) -> None:
    for name in LAYERS:
        layer = read_image(runs[0] / name)
        assert layer.shape == (216, 384, 3)
        assert layer.std() > 5
    assert read_image(runs[0] / "contact-sheet.png").shape[1] > 1900
