"""A folder with everything that the commands of the pages name, small, and a daemon that they can ask."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from calib.cost_run import misaligned
from calib.photo_trial import simulated_photographs
from calib.placed import misplaced
from calib.vernier import nominal, simulate, write_settings
from model_export.checkpoint import save_checkpoint
from model_export.eyereal import EyeRealNet
from runtime.config import StackGeometry
from runtime.daemon.client import NotRunning, ask
from runtime.evaluation.motion_recording import write_motion
from runtime.support.artifacts import write_png
from tests.calib.test_windows import CONFIG as ON_MONITORS
from tests.page.rig import short_folder
from tests.report.test_bench import regression_file
from tests.report.test_pairs import case_folder
from tests.test_cli import PANELS, pair_in
from tests.waiting import eventually

ROOT = Path(__file__).resolve().parents[1]
STACK = StackGeometry().stack()  # full size: the marks of a board want rows
CONFIG = """
[stack]
width_px = {width}
height_px = {height}
[sensor]
driver = "replay"
source = "demo"
loop = true
[model]
name = "fast"
threads = 1
[content]
external = "content.sock"
[loop]
rate_hz = 10.0
solver_late_s = 10.0
[service]
socket = "s.sock"
blackbox_folder = "boxes"
"""
MONITORS = "".join(f'[[output.panels]]\nconnector = "HDMI-{index}"\n' for index in range(3))
PLAYLIST = "".join(f'[[show]]\nscene = "{scene}"\nseconds = 600\n' for scene in ("demo", "texture"))
# Made as the pages make them, smaller: what a command reads, another one has written.
MADE = (
    "phasestack run --replay demo --headless --max-speed --frames 5 --scale 0.1 --record run.mcap",
    "phasestack calibrate capture --replay demo --out pairs.csv",
    "phasestack calibrate solve --pairs pairs.csv --out calibration.toml",
    "phasestack export --arch eyereal --random-init 1 --precision int8 --width 64 --height 64 --base-width 16"
    " --out small.onnx",
)


class Workshop:
    """Folders in which the pages' commands are typed, each a copy of the first. `close` ends the daemon."""

    def __init__(self, folder: Path) -> None:
        """folder: new, and short, since the daemon's socket lies in it."""
        self._programs = folder / "bin"
        self._stock = folder / "stock"
        self._home = folder / "daemon"
        self._daemon: subprocess.Popen[bytes] | None = None
        for made in (self._programs, self._stock, self._home):
            made.mkdir()
        self._supervisor = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)  # systemd's; nobody reads what it is told
        self._supervisor.bind(str(self._home / "notify"))
        for name, module in (("phasestack", "runtime.cli"), ("torchrun", "torch.distributed.run")):
            program = self._programs / name
            program.write_text(f'#!/bin/sh\nexec {sys.executable} -m {module} "$@"\n')
            program.chmod(0o755)
        _fill(self._stock)
        for line in MADE:
            done = self.typed(line, self._stock)
            assert done.returncode == 0, f"{line}\n{done.stderr}"

    @property
    def socket(self) -> Path:
        return self._home / "s.sock"

    @contextmanager
    def copied(self) -> Iterator[Path]:
        """A folder with all files, into which a command may write; gone afterwards."""
        with short_folder() as above:
            folder = above / "w"
            shutil.copytree(self._stock, folder, ignore=shutil.ignore_patterns("photos"))
            (folder / "photos").symlink_to(self._stock / "photos")
            yield folder

    def started(self, line: str, folder: Path, *, display: str = "") -> subprocess.Popen[str]:
        """A command line in a shell, as a person would type it there. Without a display there is no screen."""
        environment = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY")}
        environment |= {"PATH": f"{self._programs}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}
        environment |= {"DISPLAY": display} if display else {}
        pipe = subprocess.PIPE
        return subprocess.Popen(
            ["bash", "-o", "pipefail", "-c", line],
            cwd=folder, env=environment, stdin=pipe, stdout=pipe, stderr=pipe, text=True,
        )  # fmt: skip

    def typed(
        self, line: str, folder: Path, *, keys: str = "", display: str = "", within_s: float = 1700.0
    ) -> subprocess.CompletedProcess[str]:
        """The same, with the keys that the person presses, until it is done."""
        with self.started(line, folder, display=display) as running:
            try:
                out, err = running.communicate(keys, timeout=within_s)
            except BaseException:
                running.kill()
                raise
        return subprocess.CompletedProcess(line, running.returncode, out, err)

    def told_to_end(self, line: str, folder: Path, *, at: str) -> subprocess.CompletedProcess[str]:
        """The same of what runs until SIGTERM, which it gets when a line of its stderr has `at` in it."""
        with self.started(line, folder) as running:
            try:
                said = ""
                while at not in said and (more := running.stderr.readline()):
                    said += more
                running.terminate()
                out, err = running.communicate(timeout=60)
            except BaseException:
                running.kill()
                raise
        assert at in said, said + err
        return subprocess.CompletedProcess(line, running.returncode, out, said + err)

    def wake_daemon(self) -> None:
        """A daemon that answers: the one that runs, or a new one."""
        if self._daemon is not None and self._daemon.poll() is None:
            return
        config = self._home / "d.toml"
        config.write_text(CONFIG.format(width=192, height=108))
        unit = {"NOTIFY_SOCKET": str(self._home / "notify"), "PHASESTACK_UNIT_RESTARTS": "1"}
        environment = os.environ | {"PYTHONPATH": str(ROOT)} | unit
        with (self._home / "log").open("wb") as log:
            self._daemon = subprocess.Popen(
                [sys.executable, "-m", "runtime.cli", "run", "--config", str(config), "--headless"],
                cwd=self._home, env=environment, stdout=log, stderr=log,
            )  # fmt: skip
        assert eventually(self._answers, within_s=120), (self._home / "log").read_text()

    def daemon_ended(self) -> int:
        """The exit code of the daemon, which was told to end."""
        assert self._daemon is not None
        return self._daemon.wait(timeout=60)

    def close(self) -> None:
        if self._daemon is not None and self._daemon.poll() is None:
            self._daemon.terminate()
            self._daemon.wait(timeout=60)
        self._supervisor.close()

    def _answers(self) -> bool:
        try:
            return ask((self.socket,), {"command": "status"}).get("state") == "tracking"
        except NotRunning:
            return False


def _fill(folder: Path) -> None:
    """Everything that a person, a camera or a photometer would have brought."""
    random = np.random.default_rng(2)
    (folder / "phasestack.toml").write_text(CONFIG.format(width=STACK.width_px, height=STACK.height_px) + MONITORS)
    (folder / "monitors.toml").write_text(ON_MONITORS)
    (folder / "small.json").write_text(json.dumps(PANELS | {"width_px": 384, "height_px": 216}))
    (folder / "no-prediction.toml").write_text("[tracker]\nhorizon_max_s = 0\n")
    (folder / "playlist.toml").write_text(PLAYLIST)
    pair_in(folder)
    for name in ("left", "right"):
        (folder / f"{name}.png").rename(folder / f"{name[0]}.png")
    for motion in ("lean", "walk"):
        write_motion(folder / f"{motion}.mcap", motion, seconds=2.0)
    settings = simulate(
        nominal((0.5, 0.0, 0.0), STACK, reference=1), STACK, misaligned(STACK, reference=1, random=random),
        noise_px=0.05, viewpoint_error_m=np.zeros(3), random=random,
    )  # fmt: skip
    write_settings(folder / "vernier.csv", settings)
    greys = np.linspace(0.0, 1.0, 9)
    luminance = 0.3 + 120.0 * np.sin(np.pi / 2 * greys**1.1) ** 2
    np.savetxt(
        folder / "photometer.csv", np.column_stack([greys, luminance]), delimiter=",", header="grey,luminance",
        comments="",
    )  # fmt: skip
    truth = misplaced(STACK, shift_m=0.002, turn_deg=1.0, gap_m=0.002, random=random)
    for number, picture in enumerate(simulated_photographs(STACK, truth, count=7, megapixels=6.0, random=random)):
        write_png(folder / "photos" / f"{number + 1}.png", picture)
    for name, ms in (("old", 100.0), ("new", 101.0)):
        (folder / f"{name}.json").write_text(json.dumps(regression_file(ms=ms)))
    save_checkpoint(folder / "published.pth", {"model": EyeRealNet(4).state_dict()})
    (folder / "my-pairs").mkdir()
    case_folder(folder / "my-pairs")
