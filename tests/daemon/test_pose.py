"""Tests that the head pose goes out as OpenTrack's datagrams, and only if it is told to."""

from __future__ import annotations

import json
import math
import socket
import struct
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from runtime.config import PoseSettings
from runtime.daemon.pose import PoseSender, pose_of
from runtime.errors import InputError

HALF_IPD_M = 0.0315
ORIGIN_M = (0.6, 0.0, 0.0)
CONFIG = """
[stack]
width_px = 160
height_px = 90
[model]
name = "fast"
threads = 1
[service]
socket = "{socket}"
blackbox_minutes = 0.0
[pose]
port = {port}
smoothing_ms = 0.0
"""
AUDITED = (
    "import sys; tell = lambda event, _: event == 'socket.sendto' and print('SENT', file=sys.stderr); "
    "sys.addaudithook(tell); "
    "from runtime.cli import main; main()"
)


def turned(yaw_deg: float, roll_deg: float) -> np.ndarray:
    """Eyes of a head at the origin that turned to its right, and then leaned to its right shoulder."""
    yaw, roll = math.radians(yaw_deg), math.radians(roll_deg)
    right = np.array([math.sin(yaw) * math.cos(roll), math.cos(yaw) * math.cos(roll), -math.sin(roll)])
    return np.add(ORIGIN_M, [-HALF_IPD_M * right, HALF_IPD_M * right])


@pytest.mark.parametrize(
    ("moved_m", "pose"),
    [
        ((0, 0, 0), (0, 0, 0, 0, 0, 0)),
        ((0, 0.1, 0), (10, 0, 0, 0, 0, 0)),
        ((0, 0, 0.1), (0, 10, 0, 0, 0, 0)),
        ((-0.1, 0, 0), (0, 0, 10, 0, 0, 0)),
    ],
)
def test_x_is_right_y_is_up_z_is_towards_the_display(moved_m: tuple[float, ...], pose: tuple[float, ...]) -> None:
    np.testing.assert_allclose(pose_of(turned(0, 0) + moved_m, ORIGIN_M), pose, atol=1e-9)


@pytest.mark.parametrize(("yaw_deg", "roll_deg"), [(20, 0), (-35, 0), (0, 15), (0, -15), (25, -10)])
def test_yaw_is_to_the_right_and_roll_to_the_right_shoulder(yaw_deg: float, roll_deg: float) -> None:
    np.testing.assert_allclose(pose_of(turned(yaw_deg, roll_deg), ORIGIN_M)[3:], (yaw_deg, 0, roll_deg), atol=1e-9)


def run_for_a_second(folder: Path, port: int, more: str = "") -> tuple[list[dict], str]:
    """The lines of frames.jsonl of a run with a walking viewer on the real clock, and what it wrote to stderr."""
    (folder / "c.toml").write_text(CONFIG.format(socket=folder / "s", port=port) + more)
    recording = str(folder / "walk.mcap")
    command = [sys.executable, "-c", AUDITED]
    subprocess.run([*command, "record", "--motion", "walk", "--seconds", "3", "--out", recording], check=True)
    options = ["--config", str(folder / "c.toml"), "--replay", recording, "--headless", "--frames", "90"]
    done = subprocess.run([*command, "run", *options, "--out", str(folder / "out")], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in (folder / "out" / "frames.jsonl").read_text().splitlines()], done.stderr


@pytest.mark.slow
def test_a_receiver_gets_the_poses_of_the_frames(tmp_path: Path) -> None:
    received: list[tuple[float, ...]] = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(1.0)
        ended = threading.Event()

        def receive() -> None:
            while not ended.is_set():
                try:
                    received.append(struct.unpack("<6d", receiver.recv(1000)))
                except TimeoutError:
                    continue

        thread = threading.Thread(target=receive)
        thread.start()
        lines, told = run_for_a_second(tmp_path, receiver.getsockname()[1])
        ended.set()
        thread.join()
    assert "SENT" in told and len(received) > 10
    poses = [pose_of(np.array(line["eyes_m"]), ORIGIN_M) for line in lines if line["eyes_m"] is not None]
    for pose in received:
        assert min(np.abs(np.subtract(pose, one)).max() for one in poses) < 1e-3  # the file is rounded
    assert np.ptp(np.array(received)[:, 0]) > 1  # the viewer walks


@pytest.mark.slow
def test_an_lsl_recorder_gets_the_poses(tmp_path: Path) -> None:
    pylsl = pytest.importorskip("pylsl")
    name, received = f"pose of {tmp_path.name}", []

    def receive() -> None:
        (found,) = pylsl.resolve_byprop("name", name, timeout=60)
        inlet = pylsl.StreamInlet(found)
        labels = inlet.info().desc().child("channels").child("channel").child_value("label")
        while (pose := inlet.pull_sample(timeout=3.0)[0]) is not None:
            received.append(pose)
        received.append(labels)

    thread = threading.Thread(target=receive)
    thread.start()
    lines, _ = run_for_a_second(tmp_path, 0, more=f'lsl = "{name}"')
    thread.join()
    poses = [pose_of(np.array(line["eyes_m"]), ORIGIN_M) for line in lines if line["eyes_m"] is not None]
    assert received.pop() == "x" and len(received) > 10
    for pose in received:
        assert min(np.abs(np.subtract(pose, one)).max() for one in poses) < 1e-3  # the file is rounded


@pytest.mark.slow
def test_nothing_is_sent_unless_it_is_told_to(tmp_path: Path) -> None:
    lines, told = run_for_a_second(tmp_path, 0)
    assert any(line["eyes_m"] is not None for line in lines) and "SENT" not in told


def test_poses_go_to_this_computer_unless_told_otherwise() -> None:
    assert (PoseSettings().host, PoseSettings().port, PoseSettings().lsl) == ("127.0.0.1", 0, "")


def test_an_unknown_host_is_refused_in_one_line() -> None:
    with pytest.raises(InputError, match=r"pose: host: nobody\.invalid"):
        PoseSender(PoseSettings(host="nobody.invalid", port=4242))
