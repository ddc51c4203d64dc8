"""Tests the pictures that a web page's camera sends."""

from __future__ import annotations

import zlib

import cv2
import numpy as np
import pytest

from runtime.browser.link import BrowserLink, PageMode
from runtime.clock import SimulatedClock
from runtime.errors import SensorTimeout
from runtime.optics.stack import PanelStack
from runtime.sensor.browser import PICTURE_MAX_PX, BrowserCamera


def sent(coded: bytes) -> BrowserCamera:
    link = BrowserLink(PageMode(PanelStack(0.5, 0.3, (-0.06, 0.0, 0.06), 32, 18), fov_deg=40.0))
    link.send_picture(coded, 5.0)
    camera = BrowserCamera(link, SimulatedClock())
    camera.open()
    return camera


def png_of(width: int, height: int) -> bytes:
    """A grey PNG whose rows are all zero, of a few bytes per row."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        body = kind + data
        return len(data).to_bytes(4, "big") + body + zlib.crc32(body).to_bytes(4, "big")

    head = width.to_bytes(4, "big") + height.to_bytes(4, "big") + bytes([8, 0, 0, 0, 0])
    rows = zlib.compress(bytes((width + 1) * height), 9)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def test_a_picture_becomes_rgb_with_the_pages_field_of_view() -> None:
    bgr = np.zeros((48, 64, 3), np.uint8)
    bgr[..., 2] = 200
    frame = sent(bytes(cv2.imencode(".png", bgr)[1])).read_newest(0.1)
    assert frame.colour is not None and frame.colour[0, 0].tolist() == [200, 0, 0]
    assert frame.intrinsics is not None and frame.intrinsics.width_px == 64


def test_a_small_file_of_many_pixels_is_refused_before_it_is_decoded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("was decoded"))
    with pytest.raises(SensorTimeout, match=r"4096 by 4096 pixels; the maximum is 2048"):
        sent(png_of(2 * PICTURE_MAX_PX, 2 * PICTURE_MAX_PX)).read_newest(0.1)


@pytest.mark.parametrize("coded", [b"", b"nothing", png_of(8, 8)[:40]])
def test_what_is_no_picture_is_a_missing_sample(coded: bytes) -> None:
    with pytest.raises(SensorTimeout, match="the page sent a camera picture that"):
        sent(coded).read_newest(0.1)
