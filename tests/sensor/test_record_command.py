"""Tests that `phasestack record` writes eyes always and pictures only on request."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from runtime.commands.record import record, record_to
from runtime.config import Settings, validated
from runtime.errors import FatalError, InputError
from runtime.evaluation.motion_recording import write_motion
from runtime.sensor.recording import Recording
from tests.calls import answered, invoked

RUN = "import typer; from runtime.commands.record import record; typer.run(record)"


def settings(**sensor: Any) -> Settings:
    return validated(Settings, {"sensor": sensor}, source="test")


def test_a_recording_of_the_demo_has_its_samples(tmp_path: Path) -> None:
    out = tmp_path / "new" / "a.mcap"
    summary = answered(record, "--out", out, "--seconds", 1)
    frames = list(Recording(out).samples())
    assert summary["samples"] == len(frames) and 25 <= len(frames) <= 31
    assert summary["seconds"] <= 1.0 and summary["stopped"] == "reached the time limit"
    assert frames[0].eyes is not None and frames[0].true_eyes_m is not None


def test_a_source_that_ends_ends_the_recording(tmp_path: Path) -> None:
    write_motion(tmp_path / "m.mcap", "still", seconds=1.0)
    source = settings(source=str(tmp_path / "m.mcap"))
    summary = record_to(tmp_path / "a.mcap", source, images=False, seconds=30)
    assert "the recording has ended" in summary["stopped"] and summary["samples"] >= 10


def test_ctrl_c_ends_it_properly(tmp_path: Path) -> None:
    out = tmp_path / "a.mcap"
    process = subprocess.Popen([sys.executable, "-c", RUN, "--out", str(out)], stderr=subprocess.DEVNULL)
    end = time.monotonic() + 20
    while not out.exists() and time.monotonic() < end:
        time.sleep(0.05)
    time.sleep(0.3)
    process.send_signal(signal.SIGINT)
    assert process.wait(20) == 0
    recording = Recording(out)
    assert list(recording.samples()) and recording.is_whole


def test_a_sensor_that_gives_nothing_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("runtime.commands.record.FIRST_SAMPLE_S", 0.3)
    with pytest.raises(FatalError, match="usb-camera"):
        record_to(
            tmp_path / "a.mcap",
            settings(driver="usb-camera", source="/dev/video77", fov_deg=60.0),
            images=False,
            seconds=1,
        )
    assert list(tmp_path.iterdir()) == []


def test_pictures_are_kept_only_with_images(tmp_path: Path) -> None:
    from tests.eyes.scene import IPD_M, camera, scene
    from tests.sensor.oni_file import write_oni

    view = camera(640, 480, 60.0)
    colour, depth, _ = scene(np.array([0.0, 0.0, 0.6]), intrinsics=view)
    fov = (np.radians(60.0), 2 * np.arctan(240 / view.fy_px))
    write_oni(tmp_path / "v.oni", np.repeat(depth[None], 12, 0), np.repeat(colour[None], 12, 0), fov_rad=fov)
    source = settings(driver="openni2", source=str(tmp_path / "v.oni"), loop=True)
    for images in (False, True):
        record_to(tmp_path / "a.mcap", source, images=images, seconds=0.5)
        frames = list(Recording(tmp_path / "a.mcap").samples())
        assert all((f.depth_mm is not None) == images for f in frames)
        assert any(f.colour is not None for f in frames) == images
        found = [np.linalg.norm(np.diff(f.eyes.eyes_m, axis=0)) for f in frames if f.eyes is not None]
        assert np.median(found) == pytest.approx(IPD_M, abs=0.004)


def test_a_motion_replaces_only_a_motion_and_a_sensor_replaces_nothing(tmp_path: Path) -> None:
    """Seen: a sensor's recording was gone after `record --motion` to the same name, without a word."""
    out = tmp_path / "a.mcap"
    motion, sensor = ["--motion", "still", "--seconds", "1"], ["--seconds", "0.5"]

    def made(*arguments: str) -> bool:
        """False: refused, and the existing file stays."""
        before = out.read_bytes() if out.exists() else b""
        answer = invoked(record, *arguments, "--out", str(out))
        if answer.exit_code == 0:
            return out.read_bytes() != before
        assert isinstance(answer.exception, InputError) and "choose another name" in str(answer.exception)
        assert out.read_bytes() == before
        return False

    assert made(*motion) and not made(*sensor)
    assert made(*motion, "--seed", "5")  # reproducible from its seed
    out.unlink()
    assert made(*sensor) and not made(*motion)
    out.write_bytes(b"something else")
    assert not made(*motion)


@pytest.mark.parametrize("name", ["a.txt", "a", "a.mcap.bak", "x" * 5000 + ".mcap"])
def test_a_name_without_the_recording_suffix_is_refused_at_once(tmp_path: Path, name: str) -> None:
    answer = invoked(record, "--motion", "still", "--out", f"{tmp_path}/{name}")
    assert isinstance(answer.exception, InputError)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(os.getuid() != 0, reason="only root can be another user")
@pytest.mark.parametrize("folder", ["closed", "closed/new", "bare"])
def test_a_forbidden_place_is_refused_in_one_line(folder: str) -> None:
    """For nobody (65534): a folder that may not be looked into, and one that may not be written to."""
    with tempfile.TemporaryDirectory() as root:
        Path(root).chmod(0o755)
        (Path(root) / "bare").mkdir(mode=0o755)
        (Path(root) / "closed").mkdir(mode=0o700)
        os.seteuid(65534)
        try:
            answer = invoked(record, "--seconds", "0.5", "--out", f"{root}/{folder}/a.mcap")
        finally:
            os.seteuid(0)
    assert isinstance(answer.exception, InputError)
    assert "cannot be written: Permission denied" in str(answer.exception)


def test_a_file_where_the_folder_should_be_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    answer = invoked(record, "--motion", "still", "--out", str(tmp_path / "file" / "a.mcap"))
    assert f"{tmp_path / 'file'} is not a folder" in str(answer.exception)


def test_images_of_a_sensor_that_has_none_are_not_claimed(tmp_path: Path) -> None:
    answer = invoked(record, "--images", "--seconds", "0.5", "--out", str(tmp_path / "a.mcap"))
    assert answer.exit_code == 0 and "eyes" in answer.stdout
    assert "colour" not in answer.stdout
