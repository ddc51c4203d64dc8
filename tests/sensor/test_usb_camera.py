"""Tests the driver `usb-camera` with a film in place of a camera, which no test machine has."""

from __future__ import annotations

import io
import socket
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

import cv2
import numpy as np
import pytest
from PIL import Image

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
    finder = EyeFinder(Settings(sensor=sensor))
    with driver:
        frames = [searched(driver.read_newest(1.0), finder) for _ in range(5)]
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


class Answers(BaseHTTPRequestHandler):
    """A network camera: an MJPEG stream at /stream, errors elsewhere."""

    def do_GET(self) -> None:
        code = {"/private": 401, "/banned": 403, "/gone": 404}.get(self.path, 200)
        self.send_response(code)
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=next")
        self.end_headers()
        if self.path == "/stream":
            coded = io.BytesIO()
            Image.new("RGB", (64, 48), (200, 30, 30)).save(coded, "JPEG")
            for _ in range(20):
                self.wfile.write(b"--next\r\nContent-Type: image/jpeg\r\n\r\n" + coded.getvalue() + b"\r\n")

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def server() -> Iterator[int]:
    with ThreadingHTTPServer(("127.0.0.1", 0), Answers) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        yield server.server_port
        server.shutdown()


def test_a_network_cameras_pictures_are_read(server: int) -> None:
    with open_sensor(settings(f"http://127.0.0.1:{server}/stream"), MonotonicClock()) as driver:
        frame = driver.read_newest(1.0)
        assert frame.colour is not None and frame.colour.shape == (48, 64, 3)
        assert np.abs(frame.colour.reshape(-1, 3).mean(0) - (200, 30, 30)).max() < 6


@pytest.mark.parametrize(
    ("path", "told"),
    [
        ("private", "asks for a password; write user:password@ before the host in sensor.source"),
        ("banned", "refuses this user"),
        ("gone", "has no stream of this name"),
        ("text", "sends no pictures"),
    ],
)
def test_a_network_cameras_refusal_is_told_without_its_password(
    server: int, capfd: pytest.CaptureFixture[str], path: str, told: str
) -> None:
    with pytest.raises(SensorLost, match=told) as lost:
        open_sensor(settings(f"http://me:secret@127.0.0.1:{server}/{path}"), MonotonicClock()).open()
    assert "secret" not in str(lost.value) and "other programs" not in str(lost.value)
    assert capfd.readouterr().err == ""  # nothing from FFmpeg


def test_a_camera_that_is_off_or_silent_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("runtime.support.film.ANSWERS_IN_S", 0.2)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        port = silent.getsockname()[1]
        with pytest.raises(SensorLost, match="does not answer"):
            open_sensor(settings(f"http://127.0.0.1:{port}/"), MonotonicClock()).open()
        with pytest.raises(SensorLost, match="does not answer"):
            open_sensor(settings(f"rtsp://127.0.0.1:{port}/"), MonotonicClock()).open()
    with pytest.raises(SensorLost, match="refuses connections"):
        open_sensor(settings(f"http://127.0.0.1:{port}/"), MonotonicClock()).open()
