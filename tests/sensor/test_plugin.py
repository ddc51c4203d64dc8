"""A sensor of a user's own: one file on Python's path, one line of TOML; and what a wrong one is told."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
RECORD = [sys.executable, "-m", "runtime.cli", "record", "--config", "own.toml", "--out", "o.mcap", "--seconds", "1"]


def record(folder: Path, sensor: str) -> subprocess.CompletedProcess[str]:
    (folder / "own.toml").write_text(f"[sensor]\n{sensor}\n")
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(folder), str(ROOT)])}
    command = [*RECORD, "--json"]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=120)


def test_the_example_delivers_from_a_folder_of_its_own_with_its_covariance(tmp_path: Path) -> None:
    shutil.copy(ROOT / "examples" / "udp_eyes.py", tmp_path)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    done = threading.Event()

    def send() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            for number in range(1, 10_000):
                message = {"n": number, "t_ns": time.monotonic_ns(), "left": [0.03, 0, 0.6], "right": [-0.03, 0, 0.6]}
                sender.sendto(json.dumps(message).encode(), ("127.0.0.1", port))
                if done.wait(0.02):
                    return

    thread = threading.Thread(target=send)
    thread.start()
    try:
        ran = record(tmp_path, f'driver = "udp_eyes:UdpEyes"\noptions = {{ port = {port} }}')
    finally:
        done.set()
        thread.join()
    assert ran.returncode == 0, ran.stderr
    assert json.loads(ran.stdout)["samples"] > 10
    from runtime.sensor.recording import Recording

    first = Recording(tmp_path / "o.mcap").first
    assert first.eyes.eyes_m.tolist() == [[0.03, 0.0, 0.6], [-0.03, 0.0, 0.6]]
    assert first.eyes.covariance_m2.diagonal().tolist() == pytest.approx([2.5e-7, 2.5e-7, 4e-6])


@pytest.mark.parametrize(
    ("sensor", "told"),
    [
        ('driver = "udp_eyes:UdpEyes"\noptions = { port = 99999 }', "sensor.options: port: "),
        ('driver = "udp_eyes:UdpEyes"', "sensor.options: port: "),
        ('driver = "gone:UdpEyes"', "sensor.driver: `gone` cannot be imported from Python's path"),
        ('driver = "json:JSONDecoder"', "`json:JSONDecoder` is no class that derives from phasestack.Sensor"),
        ('driver = "openni"', "did you mean openni2?"),
    ],
)
def test_a_wrong_one_is_one_line(tmp_path: Path, sensor: str, told: str) -> None:
    shutil.copy(ROOT / "examples" / "udp_eyes.py", tmp_path)
    done = record(tmp_path, sensor)
    assert done.returncode == 2 and told in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1 and not (tmp_path / "o.mcap").exists()
