"""Tests the real OpenNI2 library with recordings that the test makes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from runtime.clock import MonotonicClock
from runtime.config import SensorSettings
from runtime.errors import EndOfRecording, InputError, MissingPart, SensorLost
from runtime.sensor.openni2 import OpenNI2Driver
from runtime.sensor.openni2_library import find_library
from tests.sensor.oni_file import write_oni

try:
    find_library()
except MissingPart as missing:
    pytest.skip(str(missing), allow_module_level=True)


@pytest.fixture(scope="module")
def oni(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Eight frames: depth rises by 10 mm a frame and has a hole; colour is red on the left."""
    path = tmp_path_factory.mktemp("oni") / "made.oni"
    depth = np.full((8, 120, 160), 700, np.uint16) + 10 * np.arange(8, dtype=np.uint16)[:, None, None]
    depth[:, 50:60, 70:80] = 0
    colour = np.zeros((8, 120, 160, 3), np.uint8)
    colour[:, :, :80, 0] = 200
    write_oni(path, depth, colour, fov_rad=(1.0, 0.8))
    return path


def driver_for(source: Any, **more: Any) -> Any:
    return OpenNI2Driver(SensorSettings(driver="openni2", source=str(source), **more), MonotonicClock())


def test_a_recording_delivers_depth_colour_and_intrinsics_at_its_own_pace(oni: Any) -> None:
    clock, frames = MonotonicClock(), []
    with driver_for(oni) as driver:
        for _ in range(6):
            frames.append(driver.read_newest(0.5))
            assert frames[-1].capture_ns <= clock.now_ns()
        assert driver.capabilities.depth and driver.capabilities.colour
    depths = [int(f.depth_mm[0, 0]) for f in frames]
    assert depths == sorted(set(depths)) and set(depths) <= set(range(700, 780, 10))
    assert frames[0].depth_mm.shape == (120, 160) and not frames[0].depth_mm[50:60, 70:80].any()
    assert frames[-1].colour[0, 0].tolist() == [200, 0, 0] and frames[-1].colour[0, 159].tolist() == [0, 0, 0]
    camera = frames[0].intrinsics
    assert (camera.width_px, camera.height_px, camera.cx_px, camera.cy_px) == (160, 120, 80.0, 60.0)
    assert camera.fx_px == pytest.approx(80 / np.tan(0.5), rel=1e-6)
    assert camera.fy_px == pytest.approx(60 / np.tan(0.4), rel=1e-6)
    steps = np.diff([f.capture_ns for f in frames]) / np.diff([f.sequence for f in frames])
    assert np.median(steps) == pytest.approx(1e9 / 30, rel=0.1)


def test_a_recording_ends_unless_looped_and_can_be_reopened(oni: Any) -> None:
    driver = driver_for(oni)
    with driver, pytest.raises(EndOfRecording):
        for _ in range(20):
            driver.read_newest(0.3)
    driver.close()
    with pytest.raises(SensorLost):
        driver.read_newest(0.1)
    with driver:
        assert driver.read_newest(0.5).depth_mm is not None
    with driver_for(oni, loop=True) as driver:
        sequence = [driver.read_newest(0.5).sequence for _ in range(20)]
    assert sequence == sorted(set(sequence))


@pytest.mark.parametrize("content", [b"", b"not an oni file", b"NI10" + bytes(60)], ids=range(3))
def test_what_is_no_recording_or_holds_no_library_is_named(tmp_path: Path, content: Any) -> None:
    (tmp_path / "bad.oni").write_bytes(content)
    with pytest.raises(SensorLost, match="OpenNI2"):
        driver_for(tmp_path / "bad.oni").open()
    with pytest.raises(InputError, match="none"):
        driver_for(tmp_path / "none.oni").open()
    with pytest.raises(MissingPart, match=str(tmp_path)):
        find_library(str(tmp_path))


NO_CAMERA = """
from runtime.clock import MonotonicClock
from runtime.config import SensorSettings
from runtime.errors import SensorLost
from runtime.sensor.openni2 import OpenNI2Driver
try:
    OpenNI2Driver(SensorSettings(driver="openni2", source="SERIAL-1"), MonotonicClock()).open()
except SensorLost as error:
    print(error)
"""


def test_without_a_camera_it_is_lost_and_names_the_serial() -> None:
    answer = subprocess.run([sys.executable, "-c", NO_CAMERA], capture_output=True, timeout=60, text=True)
    assert "no OpenNI2 camera" in answer.stdout and "SERIAL-1" in answer.stdout


PLAYED_TO_THE_END = """
import sys
from runtime.clock import MonotonicClock
from runtime.config import SensorSettings
from runtime.errors import EndOfRecording
from runtime.sensor.openni2 import OpenNI2Driver
for _ in range(25):
    with OpenNI2Driver(SensorSettings(driver="openni2", source=sys.argv[1]), MonotonicClock()) as driver:
        try:
            while True:
                driver.read_newest(0.05)
        except EndOfRecording:
            pass
"""
BUSY = "while True: pass"


@pytest.mark.slow
def test_recordings_closed_at_their_end_on_a_busy_machine_end_well(oni: Any) -> None:
    """Seen in CI: the library's own thread of a file outlives its device."""
    busy = [subprocess.Popen([sys.executable, "-c", BUSY]) for _ in range(3)]
    try:
        played = [subprocess.Popen([sys.executable, "-c", PLAYED_TO_THE_END, str(oni)]) for _ in range(2)]
        assert [process.wait(timeout=120) for process in played] == [0, 0]
    finally:
        for process in busy:
            process.kill()
            process.wait()
