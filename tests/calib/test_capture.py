"""Tests that samples become pairs: a median over half a second, stored as soon as it is accepted."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from calib.capture import Walk
from calib.commands import app
from calib.hardware import SetupHardware
from calib.keys import Key, TerminalKeys, parse
from calib.pairs import PairsFile, read_pairs
from calib.viewpoints import grid
from runtime.clock import NS_PER_S
from runtime.config import Settings, with_options
from runtime.errors import InputError
from runtime.eyes.calibration import demo_stack_from_sensor
from runtime.records import EyePoints, SensorFrame
from runtime.sensor.recording import recording_to
from runtime.sensor.recording_format import RecordingHeader
from tests.calib.camera import measured
from tests.calls import answered
from tests.waiting import eventually

STEP_NS = NS_PER_S // 30


def eyes_at(stack_m: np.ndarray) -> EyePoints:
    """Two eyes about a midpoint in `stack`, as the demo's camera measures them."""
    return EyePoints(measured(stack_m + np.array([[0.0, -0.03, 0.0], [0.0, 0.03, 0.0]])), np.array([0.9, 0.9]))


def test_restless_eyes_are_not_taken(tmp_path: Path) -> None:
    said: list[str] = []
    person = Walk(PairsFile(tmp_path / "pairs.csv"), grid()[:3], say=said.append)
    for number in range(15):
        person.see(number * STEP_NS, eyes_at(np.array([0.5, 0.01 * number, 0.1])), "")
    person.press(Key.ACCEPT)
    assert "hold still" in said[-1] and not (tmp_path / "pairs.csv").exists()


def test_slow_panels_lose_no_sample(tmp_path: Path) -> None:
    hardware = SetupHardware(lambda: None)
    source = str(recording(tmp_path / "r.mcap", [np.array([0.5, 0.0, 0.1])] * 9))
    hardware.open_sensor(with_options(Settings(), replay=source))
    try:
        worker = hardware._worker
        assert worker is not None and eventually(lambda: bool(worker.state) and len(worker._frames) >= 5)
        seen = [hardware.sample(grid()[0]) for _ in range(5)]
        assert np.diff([sample[0] for sample in seen]).max() < 2 * STEP_NS
    finally:
        hardware.close()


def recording(path: Path, places: list[np.ndarray]) -> Path:
    """A second at each place, without true eye positions."""
    with recording_to(path, RecordingHeader(driver="openni2", serial="A1")) as writer:
        for number in range(30 * len(places)):
            writer.write(SensorFrame(number + 1, number * STEP_NS, eyes=eyes_at(places[number // 30])))
    return path


def test_a_recording_that_does_not_know_its_truth_is_refused(tmp_path: Path) -> None:
    path = recording(tmp_path / "r.mcap", [grid()[0].midpoint_m])
    with pytest.raises(InputError, match="contains no true eye positions"):
        answered(app, "capture", "--replay", path, "--out", tmp_path / "p.csv")
    assert not (tmp_path / "p.csv").exists()


def test_the_demo_recording_calibrates_itself(tmp_path: Path) -> None:
    """End to end: a recording's truth reproduces its geometry to the millimetre."""
    told = answered(app, "capture", "--replay", "demo", "--out", tmp_path / "p.csv")
    assert told["pairs"] >= 8
    solved = answered(app, "solve", "--pairs", tmp_path / "p.csv", "--out", tmp_path / "c.toml")
    matrix = np.array(solved["stack_from_sensor"])
    eye = np.array([0.0, 0.0, 0.6, 1.0])
    assert np.linalg.norm((matrix - demo_stack_from_sensor()) @ eye) < 0.002


def test_a_person_at_the_terminal_takes_pairs_from_a_sensor(tmp_path: Path) -> None:
    """Run the command in a separate process, with Enter pressed until enough samples have arrived."""
    viewpoint = grid()[0]
    source = recording(tmp_path / "r.mcap", [viewpoint.midpoint_m] * 30)
    (tmp_path / "config.toml").write_text(f'[sensor]\ndriver = "replay"\nsource = "{source}"\n')
    out = tmp_path / "p.csv"
    command = [sys.executable, "-m", "runtime.cli", "calibrate", "capture", "--out", str(out), "--json",
               "--config", str(tmp_path / "config.toml")]  # fmt: skip
    running = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    for _ in range(150):
        running.stdin.write("p\n")  # again and again the first viewpoint, until the sensor has seen enough
        running.stdin.flush()
        if out.exists():
            break
        time.sleep(0.2)
    told = json.loads(running.communicate("q", timeout=60)[0])
    assert running.returncode == 0 and told["accepted"] >= 1
    pairs = read_pairs(out)
    np.testing.assert_allclose(pairs.sensor_m[:1], [eyes_at(viewpoint.midpoint_m).eyes_m.mean(0)], atol=1e-6)
    assert pairs.sensor_serial == "A1"


@pytest.mark.parametrize(("data", "keys"), [
    (b"\n", [Key.ACCEPT]), (b"np q", [Key.NEXT, Key.PREVIOUS, Key.ACCEPT, Key.QUIT]), (b"xyz", []),
    (b"\x1b[C\x1b[D\x1b[A\x1b[B", [Key.RIGHT, Key.LEFT, Key.UP, Key.DOWN]), (b"\x1b[Zn", [Key.NEXT]),
])  # fmt: skip
def test_bytes_mean_keys(data: bytes, keys: list[Key]) -> None:
    assert parse(data) == (keys, b"")


def test_a_closed_input_quits_and_an_idle_one_says_nothing() -> None:
    reading, writing = os.pipe()
    keys = TerminalKeys(reading)
    assert keys.poll() is None
    os.write(writing, b"np344.2\n")
    assert [keys.poll(), keys.poll(), keys.line(), keys.poll()] == [Key.NEXT, Key.PREVIOUS, "344.2", None]
    os.close(writing)
    assert (keys.poll(), keys.line()) == (Key.QUIT, "q")
    keys.close()
    os.close(reading)
