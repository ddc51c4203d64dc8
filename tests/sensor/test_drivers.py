"""Tests that drivers are found without importing an SDK, and that a custom one needs one file."""

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
from typing import Any

import pytest

from runtime.clock import SimulatedClock
from runtime.config import SensorSettings
from runtime.errors import InputError
from runtime.sensor.base import SteppedSensor
from runtime.sensor.recording import Recording
from runtime.sensor.registry import open_sensor
from tests.calls import refusal

ROOT = Path(__file__).resolve().parents[2]
RECORD = [sys.executable, "-m", "runtime.cli", "record", "--json", "--config", "own.toml", "--out", "o.mcap"]


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
        (tmp_path / "own.toml").write_text(f'[sensor]\ndriver = "udp_eyes:UdpEyes"\noptions = {{ port = {port} }}\n')
        environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)])}
        command = [*RECORD, "--seconds", "1"]
        ran = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=120)
    finally:
        done.set()
        thread.join()
    assert ran.returncode == 0, ran.stderr
    assert json.loads(ran.stdout)["samples"] > 10
    first = Recording(tmp_path / "o.mcap").first
    assert first.eyes.eyes_m.tolist() == [[0.03, 0.0, 0.6], [-0.03, 0.0, 0.6]]
    assert first.eyes.covariance_m2.diagonal().tolist() == pytest.approx([2.5e-7, 2.5e-7, 4e-6])


@pytest.mark.parametrize(
    ("sensor", "told"),
    [
        ({"driver": "udp_eyes:UdpEyes", "options": {"port": 99999}}, "sensor.options: port: "),
        ({"driver": "udp_eyes:UdpEyes"}, "sensor.options: port: "),
        ({"driver": "udp_eyes:UdpEyes", "options": {"port": 9, "noise": 1}}, "sensor.options: noise: is not a setting"),
        ({"driver": "gone:UdpEyes"}, "sensor.driver: `gone` cannot be imported: "),
        ({"driver": "json:JSONDecoder"}, "`json:JSONDecoder` is not a class derived from phasestack.Sensor"),
        ({"driver": "openni"}, "did you mean openni2?"),
    ],
)
def test_a_wrong_one_is_one_line(monkeypatch: pytest.MonkeyPatch, sensor: dict[str, Any], told: str) -> None:
    monkeypatch.syspath_prepend(ROOT / "examples")
    assert told in refusal(open_sensor, SensorSettings(**sensor), SimulatedClock())


EYES = ((0.6, -0.03, 0.0), (0.6, 0.03, 0.0))


def test_no_sdk_is_imported_by_looking_drivers_up() -> None:
    code = (
        "import sys; from runtime.sensor.registry import DRIVERS, open_sensor; from runtime.config import *;"
        "from runtime.clock import *; open_sensor(SensorSettings(driver='openni2'), MonotonicClock());"
        "bad = [m for m in ('openni', 'usb', 'mcap', 'cv2') if m in sys.modules]; sys.exit(str(bad) if bad else 0)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_fixed_eyes_stand_where_the_configuration_says_or_it_is_refused() -> None:
    with pytest.raises(InputError, match="fixed_eyes_m"):
        open_sensor(SensorSettings(driver="fixed"), SimulatedClock())
    clock = SimulatedClock(50)
    driver = open_sensor(SensorSettings(driver="fixed", fixed_eyes_m=EYES), clock)
    assert isinstance(driver, SteppedSensor) and driver.capabilities.in_stack_frame
    with driver:
        frames = [driver.next_sample() for _ in range(3)]
        assert frames[2].eyes.eyes_m.tolist() == [list(e) for e in EYES]
        assert [f.sequence for f in frames] == [1, 2, 3] and frames[0].capture_ns == 50
        clock.advance_ns(10**9)
        late = driver.read_newest(0.1)
        assert late.sequence == 31 and driver.skipped == 27 and late.capture_ns <= clock.now_ns()
