"""Tests of `examples/webxr/phasestack-xr.js` in Debian's Chromium, with the scene `program`."""

from __future__ import annotations

import json
import shutil
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from socket import socket
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest

from runtime.config import ContentSettings, StackGeometry
from runtime.content.registry import open_content
from runtime.errors import ContentFailure
from runtime.plan.drawing import raster_views
from tests.browser.test_viewer import HERE, needs_chromium
from tests.page.rig import ROOT
from tests.waiting import eventually

pytestmark = pytest.mark.slow

STACK = replace(StackGeometry().stack(), width_px=480, height_px=270)
VIEWER_M = 0.6
IPD_M = 0.062
POINTS = np.array([[0, 0, -2], [0.3, 0.15, -1.2], [-0.7, -0.4, -5]])  # of `webxr.html`
EYES_M = ((0.6, 0.0, 0.0), (0.6, 0.08, 0.03), (0.5, -0.06, -0.02))


@pytest.fixture
def source() -> Iterator[Any]:
    made = open_content(ContentSettings(scene="program"), STACK, None)
    yield made
    made.close()


@contextmanager
def browsing(folder: Path, query: str, address: str) -> Iterator[subprocess.Popen[str]]:
    needs_chromium()
    for file in (HERE / "webxr.html", ROOT / "examples" / "webxr" / "phasestack-xr.js"):
        shutil.copy(file, folder)
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(SimpleHTTPRequestHandler, directory=folder)) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        page = f"http://127.0.0.1:{server.server_port}/webxr.html?{query}#phasestack={address}"
        with subprocess.Popen(
            ["node", str(HERE / "webxr.mjs"), page], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        ) as browser:
            try:
                yield browser
            finally:
                browser.communicate()
                server.shutdown()


def told(browser: subprocess.Popen[str]) -> Any:
    assert browser.stdout is not None
    return json.loads(browser.stdout.readline())["value"]


def drawn(source: Any, head_m: tuple[float, float, float]) -> list[tuple[Any, np.ndarray]]:
    """Each eye's view and picture."""
    views = raster_views(np.add(head_m, [[0, -IPD_M / 2, 0], [0, IPD_M / 2, 0]]), STACK.panel(1))
    source.expect(views, time_ns=0)
    return [(view, source.render(view, time_ns=0)) for view in views]


def patiently(source: Any, head_m: tuple[float, float, float]) -> list[tuple[Any, np.ndarray]]:
    found: list[Any] = []

    def is_drawn() -> bool:
        with suppress(ContentFailure):
            found[:] = drawn(source, head_m)
        return bool(found)

    assert eventually(is_drawn, within_s=120.0), source.problem
    return found


def places_px(view: Any, *, distance_m: float, comfort_deg: float, back_m: float = 0.0) -> np.ndarray:
    """Where the squares are seen, with distances that the comfort limits.

    Along each ray of the resting eye, 1/distance is k/distance before, plus that of the farthest comfortable point.
    """
    before = (POINTS - [0, 0, back_m]) * VIEWER_M / distance_m  # metres, from the resting eye
    rear = max(1 / VIEWER_M - np.radians(comfort_deg) / IPD_M, 0)
    k = 1 - rear * VIEWER_M
    after = before / (k + rear * -before[:, 2:])
    in_stack = np.column_stack([VIEWER_M + after[:, 2], after[:, 0], after[:, 1], np.ones(3)])
    seen = in_stack @ view.pixels_from_stack.T
    return np.asarray(seen[:, :2] / seen[:, 2:])


def squares_px(picture: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Centres of the white squares, each within 12 pixels of a place."""
    grey = picture[..., 1].astype(float) / 255
    grey[grey < 0.1] = 0
    v, u = np.mgrid[: grey.shape[0], : grey.shape[1]] + 0.5
    found = []
    for place in near:
        weight = grey * ((abs(u - place[0]) < 12) & (abs(v - place[1]) < 12))
        found.append([(weight * u).sum() / weight.sum(), (weight * v).sum() / weight.sum()])
    return np.array(found)


@pytest.mark.parametrize(
    ("query", "distance_m", "comfort_deg", "error_px"),
    [
        ("mode=immersive-vr", 2.0, 1.0, 0.2),
        ("mode=immersive-vr&bare", 2.0, 1.0, 0.2),
        ("mode=inline", 2.0, 1.0, 0.7),  # as sharp as the page's canvas
    ],
)
def test_squares_are_where_the_geometry_puts_them(
    source: Any, tmp_path: Path, query: str, distance_m: float, comfort_deg: float, error_px: float
) -> None:
    with browsing(tmp_path, query, source.program["address"]) as browser:
        for head_m in EYES_M:
            for view, picture in patiently(source, head_m):
                expected = places_px(view, distance_m=distance_m, comfort_deg=comfort_deg)
                np.testing.assert_allclose(squares_px(picture, expected), expected, atol=error_px)
        assert told(browser) == "" and "token" not in told(browser)


def test_settings_of_the_address_set_distance_comfort_and_place(source: Any, tmp_path: Path) -> None:
    address = f"{source.program['address']}&comfort=20&distance=1.5&back=0.25"
    with browsing(tmp_path, "mode=immersive-vr", address):
        for head_m in EYES_M:
            for view, picture in patiently(source, head_m):
                expected = places_px(view, distance_m=1.5, comfort_deg=20, back_m=0.25)
                inside = ((expected > 10) & (expected < np.array([470, 260]))).all(1)
                assert inside.sum() > 1
                np.testing.assert_allclose(squares_px(picture, expected)[inside], expected[inside], atol=0.2)


def test_a_page_connects_again_and_its_end_is_told(source: Any, tmp_path: Path) -> None:
    with browsing(tmp_path, "mode=immersive-vr", source.program["address"]):
        patiently(source, EYES_M[0])
        source.close()
        port = urlsplit(source.program["address"]).port
        assert eventually(lambda: is_refused(port))
        again = open_content(ContentSettings(scene="program"), STACK, None)
        patiently(again, EYES_M[0])
    assert eventually(lambda: again.problem == "the program closed the connection")
    again.close()


def is_refused(port: int | None) -> bool:
    with socket() as client:
        return client.connect_ex(("127.0.0.1", port)) != 0


def test_a_wrong_token_is_told_to_the_page(source: Any, tmp_path: Path) -> None:
    address = source.program["address"].partition("=")[0] + "=wrong"
    with browsing(tmp_path, "mode=immersive-vr", address) as browser:
        assert "phasestack cannot be reached at ws://" in told(browser)
