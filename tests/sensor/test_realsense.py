"""Tests the real RealSense SDK with recordings of a device that it simulates."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from runtime.clock import MonotonicClock
from runtime.config import SensorSettings
from runtime.errors import EndOfRecording, InputError, SensorLost
from tests.sensor.realsense_file import OFFSET_M, RATE_HZ, SERIAL, write_recording

pytest.importorskip("pyrealsense2")
FOCAL_PX, WIDTH_PX, HEIGHT_PX, COUNT = 150.0, 160, 120, 24


def recorded(path: Path, *, unit_m: float = 0.001) -> Path:
    """Depth rises by 10 mm a frame from 700 and has a hole; colour is red on the left."""
    depth_mm = np.full((COUNT, HEIGHT_PX, WIDTH_PX), 700.0) + 10 * np.arange(COUNT)[:, None, None]
    depth = np.rint(depth_mm * 0.001 / unit_m).astype(np.uint16)
    depth[:, 40:80, 100:120] = 0
    colour = np.zeros((COUNT, HEIGHT_PX, WIDTH_PX, 3), np.uint8)
    colour[:, :, : WIDTH_PX // 2, 0] = 200
    write_recording(path, depth, colour, focal_px=FOCAL_PX, unit_m=unit_m)
    return path


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded(tmp_path_factory.mktemp("realsense") / "made.db3")


def driver_for(source: Any, **more: Any) -> Any:
    from runtime.sensor.realsense import RealSenseDriver

    return RealSenseDriver(SensorSettings(driver="realsense", source=str(source), **more), MonotonicClock())


def depth_of(frame: Any) -> int:
    """The wall's, mm; the SDK's alignment leaves single pixels without."""
    return int(np.median(frame.depth_mm[frame.depth_mm > 0]))


def test_colour_aligned_depth_and_the_camera_s_own_intrinsics_arrive(recording: Path) -> None:
    clock, frames = MonotonicClock(), []
    with driver_for(recording) as driver:
        assert driver.serial == SERIAL
        for _ in range(5):
            frames.append(driver.read_newest(1.0))
            assert frames[-1].capture_ns <= clock.now_ns()
    frame = frames[-1]
    assert frame.colour.shape == (HEIGHT_PX, WIDTH_PX, 3) and frame.colour.dtype == np.uint8
    assert frame.colour[0, 0].tolist() == [200, 0, 0] and frame.colour[0, -1].tolist() == [0, 0, 0]
    camera = frame.intrinsics
    assert (camera.width_px, camera.height_px, camera.cx_px, camera.cy_px) == (WIDTH_PX, HEIGHT_PX, 80.0, 60.0)
    assert (camera.fx_px, camera.fy_px) == (FOCAL_PX, FOCAL_PX)
    depths = [depth_of(frame) for frame in frames]
    assert depths == sorted(set(depths)) and set(depths) <= set(range(700, 700 + 10 * COUNT, 10))
    # The hole is where the colour camera, to the right of the depth camera, sees it.
    empty = frame.depth_mm[60, : WIDTH_PX - 30] == 0
    (columns,) = np.nonzero(empty[:-4] & empty[2:-2] & empty[4:])  # the alignment leaves single pixels without depth
    assert columns.min() == pytest.approx(100 - FOCAL_PX * OFFSET_M / (depths[-1] / 1000), abs=1.5)


def test_captures_are_as_far_apart_as_the_device_says(recording: Path) -> None:
    with driver_for(recording) as driver:
        frames = [driver.read_newest(1.0) for _ in range(6)]
    sequence = [frame.sequence for frame in frames]
    assert sequence == sorted(set(sequence))
    steps_s = np.diff([f.capture_ns for f in frames]) / 1e9 / np.diff(sequence)
    assert np.median(steps_s) == pytest.approx(1 / RATE_HZ, rel=0.1)


def test_a_recording_ends_unless_looped_and_can_be_reopened(recording: Path) -> None:
    driver = driver_for(recording)
    with driver, pytest.raises(EndOfRecording):
        for _ in range(2 * COUNT):
            driver.read_newest(1.0)
    driver.close()
    with pytest.raises(SensorLost):
        driver.read_newest(0.1)
    with driver:
        assert driver.read_newest(1.0).depth_mm is not None


def test_depth_of_another_unit_is_told_in_millimetres(tmp_path: Path) -> None:
    with driver_for(recorded(tmp_path / "fine.db3", unit_m=0.0001)) as driver:
        frame = driver.read_newest(1.0)
    assert frame.depth_mm.dtype == np.uint16 and depth_of(frame) in range(700, 700 + 10 * COUNT, 10)


def test_what_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(SensorLost, match="no RealSense camera 'SERIAL-1'"):
        driver_for("SERIAL-1").open()
    with pytest.raises(InputError, match=r"none\.db3"):
        driver_for(tmp_path / "none.db3").open()
    (tmp_path / "bad.db3").write_bytes(b"not a recording")
    with pytest.raises(SensorLost, match="RealSense"):
        driver_for(tmp_path / "bad.db3").open()
