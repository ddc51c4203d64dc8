"""Tests the driver `usb-camera` with a film in place of a camera, which no test machine has."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from runtime.clock import MonotonicClock
from runtime.config import SensorSettings, Settings
from runtime.errors import InputError, SensorLost
from runtime.eyes.detect import EyeFinder
from runtime.sensor.registry import open_sensor
from runtime.sensor.samples import searched
from tests.eyes.scene import camera, scene

PLACE = np.array([0.05, 0.0, 0.7])


@pytest.fixture
def film(tmp_path: Path) -> str:
    path = tmp_path / "film.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30, (640, 480))
    colour, _, _ = scene(PLACE, intrinsics=camera(640, 480, 65.0))
    for _ in range(5):
        writer.write(np.ascontiguousarray(colour[..., ::-1]))
    writer.release()
    return str(path)


def settings(source: str) -> SensorSettings:
    return SensorSettings(driver="usb-camera", source=source, fov_deg=65.0)


def test_without_depth_the_eyes_direction_is_right_with_sigma_along_it(film: str) -> None:
    sensor = settings(film)
    driver = open_sensor(sensor, MonotonicClock())
    find = EyeFinder(Settings(sensor=sensor)).find
    with driver:
        frames = [searched(driver.read_newest(1.0), find) for _ in range(5)]
        with pytest.raises(SensorLost, match="stopped delivering pictures"):
            driver.read_newest(1.0)
    assert [frame.sequence for frame in frames] == [1, 2, 3, 4, 5]
    middle = frames[-1].eyes.eyes_m.mean(axis=0)
    sigma = np.sqrt(np.diag(frames[-1].eyes.covariance_m2))
    assert np.abs(middle / middle[2] - PLACE / PLACE[2]).max() < 0.003
    assert abs(middle[2] - PLACE[2]) < 2.5 * sigma[2] and sigma[2] > 5 * sigma[1]


def test_what_is_no_camera_is_told() -> None:
    with pytest.raises(InputError, match="fov_deg: must be set"):
        open_sensor(SensorSettings(driver="usb-camera"), MonotonicClock())
    for source in ("tcp://127.0.0.1:9?listen=1", "concat:a.avi|b.avi"):  # one that listens, one that opens others
        with pytest.raises(InputError, match=r"source: [a-z]+ is not supported; use one of rtsp, rtsps, http, https"):
            open_sensor(settings(source), MonotonicClock())
    for source in ("97", "/dev/video97", "/dev/null"):
        with pytest.raises(SensorLost, match="/dev/"):
            open_sensor(settings(source), MonotonicClock()).open()
