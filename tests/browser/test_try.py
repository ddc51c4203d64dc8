"""Tests of `phasestack try` in Debian's Chromium, and of its connection without a browser."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from runtime.browser.link import BrowserLink, PageMode
from runtime.clock import MonotonicClock
from runtime.commands.trying import settings_of
from runtime.config import StackGeometry
from runtime.content.scenes import SCENES
from runtime.sensor.browser import BrowserEyes
from tests.browser.test_viewer import driven, needs_chromium
from tests.page.rig import ROOT
from tests.test_cli import refusal
from tests.waiting import eventually

SMALL = '[stack]\nwidth_px = 320\nheight_px = 180\n[model]\nname = "fast"\nbackend = "cpu"\n'
TRIED = (
    "no token: none", "no token: another", "the token is not in the address", "the pointer moved the head",
    "status has the eyes there to 1 mm",
    "another solution", "and the page shows it", "the picture is one", "figures are told", "light has a figure",
    "a moved head has no old figure", "and then its own", "the status and the page agree",
    "a figure's age ticks on the page", "a head that moves has no figure, whatever the server says",
    "a lost connection is tried again", "and has ended after some seconds", "and is there again",
    "imperfect panels have no figure of their own", "and are ideal again",
    "the figure stays in view at 1000 pixels", "side by side at 1000 pixels",
    "the figure stays in view at 390 pixels", "side by side at 390 pixels",
    "eyes apart by -3 mm", "eyes apart by 0 mm", "eyes apart by 500 mm", "eyes apart by  mm",
    "a near head aside sees no sliver", "both eyes are described", "what was asked for is shown", "for this head",
    "another head has another target", "and the newest again", "the solver is held", "an old status does not undo it",
    "while alignment goes on", "eyes lost: flat", "and back", "a scene that is not there",
    "a scene that is loading has no figure", "another scene", "and then a picture",
    "a new scene has no old figure", "the target is the new scene's", "another page looks on", "and takes over",
    "nobody: held, then flat", "back: tracking", "a gap out of range is refused", "it restarts, and the page says so",
    "while the rest of the page stays", "another gap", "its camera is the sensor", "and the pointer again",
    "and the scene stays",
)  # fmt: skip


@contextmanager
def trying(folder: Path, *more: str, config: str = SMALL) -> Iterator[str]:
    """The address of a running `phasestack try`; it must end well."""
    (folder / "try.toml").write_text(config)
    command = [
        sys.executable,
        "-m",
        "runtime.cli",
        "try",
        "--config",
        str(folder / "try.toml"),
        "--no-browser",
        "--json",
    ]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "STATE_DIRECTORY": str(folder)}
    with (folder / "log").open("wb") as log:
        process = subprocess.Popen(
            [*command, *more], cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=log, text=True
        )
        assert process.stdout is not None
        try:
            yield json.loads(process.stdout.readline())["url"]
        finally:
            if "reached the time limit" not in (folder / "log").read_text():
                process.terminate()
            assert process.wait(60) == 0, (folder / "log").read_text()[-3000:]
            process.stdout.close()


class Client:
    """A program that is the page: it looks, and says where the eyes are."""

    def __init__(self, url: str, **headers: str) -> None:
        parts = urlsplit(url)
        token = parts.query.removeprefix("token=")
        given = {"Authorization": f"Bearer {token}"} | {k.replace("_", "-"): v for k, v in headers.items()}
        self._connection = connect(
            f"ws://{parts.netloc}/live", additional_headers=given, max_size=None, compression=None, close_timeout=1
        )
        self.layers: dict[str, bytes] = {}
        self.sizes: dict[str, list[int]] = {}  # columns and rows; a solution may be coarser than the panels
        self.relief: np.ndarray | None = None  # of the newest solution
        self.refresh: dict[str, Any] = {}
        self.stack: dict[str, Any] = {}
        self.hears = True  # it says that it has received each refresh

    def __enter__(self) -> Client:
        self.socket = self._connection.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        self._connection.__exit__(*error)

    def look(self, within_s: float = 30.0) -> None:
        message = json.loads(self.socket.recv(within_s))
        if "layers" in message:
            kind, (width, height), received = message["layers"], message["size"], self.socket.recv(30)
            size = 4 * len(self.stack["x_m"]) * width * height
            layers, relief = received[:size], received[size:]
            self.layers[kind], self.sizes[kind] = layers, message["size"]
            if kind == "solved" and "relief" in message:
                self.relief = np.frombuffer(relief, "<f2").reshape(message["relief"][::-1])
            else:
                assert "relief" not in message and not relief
            self.socket.send(json.dumps({"drawn": True}))
        self.stack = message.get("stack", self.stack)
        if "refresh" in message:
            self.refresh = message["refresh"]
            if self.hears:
                self.say(heard=True)

    def until(self, holds: Any) -> bool:
        def looked() -> bool:
            self.look()
            return bool(holds(self))

        return eventually(looked, within_s=120.0)

    def say(self, **message: Any) -> None:
        self.socket.send(json.dumps(message))


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with trying(tmp_path_factory.mktemp("try")) as address:
        yield address


def off_m(eyes_m: list, others_m: list) -> float:
    return float(np.abs(np.subtract(eyes_m, others_m)).max())


def test_eyes_go_in_and_layers_come_out_solved_for_them(url: str) -> None:
    eyes = [[0.55, 0.02, 0.05], [0.55, 0.08, 0.05]]
    with Client(url) as client:
        client.say(eyes=eyes, page_ms=1.0)
        assert client.until(lambda c: "solved" in c.layers and c.refresh["state"] == "tracking")
        width, height = client.sizes["solved"]
        assert len(client.layers["solved"]) == 3 * width * height * 4 and client.stack["width_px"] == 320
        assert (width, height) in ((320, 180), (160, 90), (107, 60), (80, 45))
        assert client.sizes["flat"] == [320, 180]
        assert client.relief is not None and np.isfinite(client.relief).all() and client.relief.std() > 0.01
        assert client.until(lambda c: c.refresh["people"] and off_m(c.refresh["people"][0]["eyes_m"], eyes) < 1e-3)
        assert client.until(lambda c: off_m(c.refresh["solved_for"][0]["eyes_m"], eyes) < 0.002)
        client.say(eyes=None, page_ms=2.0)
        assert client.until(lambda c: c.refresh["state"] == "holding")
        assert client.until(lambda c: c.refresh["state"] == "flat" and c.refresh["flatness"] == 1.0)


def test_its_status_is_found(url: str) -> None:
    command = [sys.executable, "-m", "runtime.cli", "status", "--json"]
    asked = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert json.loads(asked.stdout)["state"], asked.stderr


def test_a_slow_page_gets_the_present_not_the_past(url: str) -> None:
    with Client(url) as client:
        client.say(eyes=[[0.6, -0.03, 0.0], [0.6, 0.03, 0.0]], page_ms=1.0)
        assert client.until(lambda c: c.refresh)
        client.hears, frames = False, set()
        with pytest.raises(TimeoutError):
            while True:
                client.look(2.0)
                frames.add(client.refresh["frame"])
        assert len(frames) <= 2
        client.say(heard=True)
        assert client.until(lambda c: c.refresh["frame"] not in frames)
        assert client.refresh["frame"] > max(frames, default=0) + 20


@pytest.mark.parametrize(
    "message", [{"eyes": "no"}, {"eyes": [[0, 0, 0], [0, 0, 0]]}, {"eyes": [[1, 2], 3]}, {"noise_mm": "x"}, [], 7, {}]
)
def test_what_is_no_message_changes_nothing(url: str, message: Any) -> None:
    with Client(url) as client:
        client.socket.send(json.dumps(message))
        client.say(eyes=[[0.6, -0.03, 0.0], [0.6, 0.03, 0.0]], page_ms=3.0)
        assert client.until(lambda c: c.refresh and c.refresh["state"] == "tracking")


@pytest.mark.parametrize("text", ["{", "x" * 100_000])
def test_who_sends_no_json_or_too_much_is_sent_away(url: str, text: str) -> None:
    with Client(url) as client:
        client.socket.send(text)
        with pytest.raises(ConnectionClosed):
            while True:
                client.look()


@pytest.mark.parametrize("headers", [{"Authorization": ""}, {"Authorization": "Bearer wrong"}])
def test_without_the_token_there_is_nothing(url: str, headers: dict) -> None:
    with pytest.raises((InvalidStatus, ConnectionClosed)), Client(url, **headers) as client:
        client.look()


def test_a_resting_head_is_sampled_on_and_captures_only_go_forward() -> None:
    link = BrowserLink(PageMode(StackGeometry().stack(), 40.0))
    samples: list[Any] = []
    with BrowserEyes(link, MonotonicClock()) as sensor:
        for page_ms in (1000.0, 1001.0):  # the second one was long under way
            link.see([[0.6, -0.03, 0.0], [0.6, 0.03, 0.0]], page_ms)
            end = len(samples) + 4
            while len(samples) < end:
                samples += sensor.read_arrived(1.0)
    captures = [sample.capture_ns for sample in samples]
    assert captures == sorted(set(captures)) and all(sample.eyes is not None for sample in samples)


@pytest.mark.parametrize(
    ("text", "width_px"), [("[content]\nfov_deg = 41.0", 960), ("[stack]\nx_m = [-0.03, 0.0, 0.03]", 1920)]
)
def test_panels_are_small_unless_the_configuration_has_a_stack(tmp_path: Path, text: str, width_px: int) -> None:
    (tmp_path / "c.toml").write_text(text)
    settings = settings_of(tmp_path / "c.toml", scene=None, layout=None, model=None, webcam=False)
    assert settings.stack.width_px == width_px and settings.content.scene == "demo"


def test_it_ends_when_its_time_is_up(tmp_path: Path) -> None:
    with trying(tmp_path, "--seconds", "1") as address:
        assert eventually(lambda: "reached the time limit" in (tmp_path / "log").read_text(), within_s=120.0), address


@pytest.mark.parametrize(("option", "value"), [("--scene", "no-such-scene"), ("--model", "none.onnx")])
def test_bad_options_are_one_line_and_exit_2(option: str, value: str) -> None:
    assert value in refusal("try", "--no-browser", option, value)


@pytest.mark.slow
def test_it_works_in_a_browser(tmp_path: Path) -> None:
    needs_chromium()
    with trying(tmp_path) as address:
        told = driven("try.mjs", address, os.environ.get("PHASESTACK_SCREENSHOTS") or tmp_path)
    assert [what for what in TRIED if told.get(what) is not True] == []
    assert [*SCENES] == told["the list has what works"][: len(SCENES)] and "lego_bulldozer" not in told[
        "the list has what works"
    ]
    assert told["elsewhere"] == [] and told["errors"] == []
