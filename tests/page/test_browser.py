"""Tests the page in Chromium with a running daemon: controls, live figures, a daemon that dies.

Needs chromium, node, and a folder NODE_PATH with playwright-core and axe-core (npm).
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from runtime.content.presets import preset_names
from runtime.content.scenes import SCENES
from runtime.daemon.client import NotRunning, ask
from tests.page.rig import CONFIGURATION, ROOT, page_of, short_folder
from tests.waiting import PATIENT, eventually

pytestmark = pytest.mark.slow

CONTROLS = (
    "pictures follow the state", "plots have an axis", "stages have a line each", "unused modules are no savings",
    "state is shown", "pictures are shown", "pause", "resume", "flat", "resume by the keyboard", "reload", "scene",
    "and those that need data are named",
    "a scene that is not there", "scene back", "black box", "it says that the daemon is gone",
    "it says that the daemon hangs", "it goes on when it hangs no more",
    "moved at once", "turntable", "any scale", "a scale out of range", "as configured",
    "another model", "the model back", "a playlist", "the next one",
    "from a playlist to a scene", "without a daemon, controls are disabled",
    "it says how to start one", "health is told",
    "panels and eyes have a place", "a pause is told", "a refused name stays", "old errors vanish",
    "not moved while typing", "loading is told", "a fault is told", "faults have their black box",
    "the list says that it is loading", "the list is soon there",
    "it goes on when it is back", "and its controls work", "fits 1280", "fits 390",
    "pause is in the first view at 1280", "pause is in the first view at 390",
)  # fmt: skip


class RunningDaemon:
    """`phasestack run` that can be killed and started again."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        library = f'[content]\nlibrary = "{folder / "library"}"\n'
        (folder / "library").mkdir()
        (folder / "d.toml").write_text(CONFIGURATION.format(width=480, height=270) + library)
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        command = [sys.executable, "-c", PATIENT, "run", "--config", str(self._folder / "d.toml"), "--headless"]
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "STATE_DIRECTORY": str(self._folder)}
        with (self._folder / "log").open("ab") as log:
            self._process = subprocess.Popen(
                [*command, "--json"], cwd=ROOT, env=environment, stdout=subprocess.DEVNULL, stderr=log
            )
        assert eventually(self._presents, within_s=120.0), (self._folder / "log").read_text()[-2000:]

    def _presents(self) -> bool:
        try:
            return ask([self._folder / "s.sock"], {"command": "status"}).get("presented", 0) > 0
        except NotRunning:
            return False

    def kill(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None

    def freeze(self) -> None:
        assert self._process is not None
        self._process.send_signal(signal.SIGSTOP)

    def thaw(self) -> None:
        assert self._process is not None
        self._process.send_signal(signal.SIGCONT)


@pytest.fixture(scope="module")
def tried(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Any]]:
    """Outcome of every step, by name."""
    modules = Path(os.environ.get("NODE_PATH", ""))
    there = all((modules / name).is_dir() for name in ("playwright-core", "axe-core"))
    if shutil.which("node") is None or shutil.which("chromium") is None or not there:
        pytest.skip("chromium, node, and a NODE_PATH with playwright-core and axe-core are needed")
    pictures = Path(os.environ.get("PHASESTACK_SCREENSHOTS") or tmp_path_factory.mktemp("pictures"))
    with short_folder() as folder, page_of(folder / "s.sock", folder) as page:
        daemon = RunningDaemon(folder)
        daemon.start()
        script = Path(__file__).with_name("drive.mjs")
        playlist = folder / "library" / "two.toml"
        playlist.write_text('[[show]]\nscene = "flat"\nseconds = 300\n[[show]]\nscene = "grey"\nseconds = 300\n')
        command = ["node", str(script), page.origin, page.token, str(pictures), str(playlist)]
        results: dict[str, Any] = {}
        try:
            with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as driver:
                assert driver.stdin is not None and driver.stdout is not None
                for line in driver.stdout:
                    told = json.loads(line)
                    results[told["what"]] = told["value"]
                    if told["what"] in ("kill", "start", "freeze", "thaw"):
                        getattr(daemon, told["what"])()
                        driver.stdin.write("done\n")
                        driver.stdin.flush()
            assert driver.returncode == 0, results
        finally:
            daemon.kill()
        yield results


@pytest.mark.parametrize("what", CONTROLS)
def test_it_works_in_a_browser(tried: dict[str, Any], what: str) -> None:
    assert tried[what] is True


def test_a_wrong_token_gets_nothing(tried: dict[str, Any]) -> None:
    assert tried["a wrong token gets nothing"] == [401] * 5


def test_figures_pictures_plots_and_eyes_move(tried: dict[str, Any]) -> None:
    assert min(tried["figures changed"]) >= 3


def test_scenes_log_and_states_are_listed(tried: dict[str, Any]) -> None:
    scenes = [name for name in tried["every scene in the list works"] if name != "\u2026"]
    assert {*SCENES, "program"} <= set(scenes) and not set(preset_names()) & set(scenes)
    assert {Path(name).name for name in scenes if name.startswith("/")} == {"two.toml"}, "the library is in the list"
    assert tried["models to choose from"] == ["fast", "balanced", "best", "sart", "\u2026"]
    assert min(tried["log and states"]) >= 2


def test_every_control_is_reached_by_the_keyboard(tried: dict[str, Any]) -> None:
    wanted = {"pause", "flat", "resume", "reload", "blackbox", "scene", "Show scene"}
    wanted |= {"model", "Use model", "place-reset"}
    wanted |= {
        f"p-{name}"
        for name in ("scale", "turntable", "out", "right", "up", "roll", "pitch", "yaw", "convergence", "comfort")
    }
    assert wanted <= set(tried["reached by tab"])


@pytest.mark.parametrize("where", ["login is accessible", "accessible at 1280", "accessible at 390"])
def test_it_is_accessible(tried: dict[str, Any], where: str) -> None:
    assert tried[where] == []


def test_nothing_comes_from_elsewhere_and_nothing_breaks_the_policy(tried: dict[str, Any]) -> None:
    assert tried["nothing from elsewhere"] == []
    assert tried["no violation of the policy, no error"] == []
