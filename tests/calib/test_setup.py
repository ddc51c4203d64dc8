"""Tests `phasestack setup` with a scripted terminal, from nothing to a correct configuration."""

from __future__ import annotations

import json
import os
import shutil
import stat
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

from calib.board import boards
from calib.config_file import put, rewrite
from calib.grey_chart import grey_charts
from calib.keys import Key
from calib.setup_run import progress_path, read_progress, walk_through
from calib.setup_steps import STEPS, Setup, SetupStopped, geometry, grey, identify, service
from calib.simulated import SimulatedHardware
from calib.viewpoints import grid
from runtime.config import Settings, load_settings
from runtime.errors import InputError
from runtime.eyes.calibration import demo_stack_from_sensor, load_calibration
from runtime.optics.malus import phase_from_intensity
from runtime.panels.monitors import Monitor
from tests.calib.simulator import Camera, by_hand, camera_from_stack, misplaced, photograph

STACK = Settings().stack.stack()
UP, DOWN = "\x1b[A", "\x1b[B"


def answers_of(hardware: SimulatedHardware) -> str:
    """The keys of a person who looks at a simulated display's cards, rear to front."""
    keys, free = "", list(range(len(hardware.order)))
    for panel in range(len(hardware.order)):
        wanted = hardware.order.index(panel)
        while free[0] != wanted:
            keys += "n"
            free.append(free.pop(0))
        rotation_deg, mirror = hardware.mounted[free.pop(0)]
        keys += "\n" + (DOWN if rotation_deg else UP) + ("n" if mirror != "none" else "\n")
    return keys


def setup_command(folder: Path, keys: str, *options: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "runtime.cli", "setup", "--config", "new.toml", "--out", "out", *options]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"}
    return subprocess.run(
        command, input=keys, cwd=folder, env=environment, capture_output=True, text=True, timeout=1700, check=False
    )


def photographs_into(folder: Path) -> None:
    """Photograph the boards and every panel's chart, on imprecisely assembled panels with a gamma."""
    random = np.random.default_rng(5)
    truth = misplaced(STACK, shift_m=0.002, turn_deg=0.25, gap_m=0.0005, random=random)
    phases = np.rint(255 * phase_from_intensity((np.arange(256) / 255) ** 2.1, branch=1)).astype(np.uint8)
    towards = [camera_from_stack(np.array([x, y, 0.05]), towards_m=np.zeros(3)) for x, y in ((0.75, 0.0), (0.78, 0.1))]
    shown = {"": (boards(STACK), by_hand(8, STACK, random=random), Camera())}
    for panel in range(STACK.count):
        shown[f"grey-{panel}"] = (grey_charts(STACK, panel), towards, Camera(2800, 2100, 2130.0, gain=0.85, dark=0.004))
    for name, (pictures, poses, camera) in shown.items():
        (folder / name).mkdir(parents=True)
        for number, pose in enumerate(poses):
            picture = photograph(phases[pictures], truth, STACK, camera, pose, random)
            cv2.imwrite(str(folder / name / f"{number}.png"), picture)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_keys_alone_lead_from_nothing_to_a_configuration_that_is_valid(tmp_path: Path) -> None:
    folder, hardware = tmp_path, SimulatedHardware(lambda: None, STACK, say=lambda text: None, seed=5)
    photographs_into(folder / "photos")
    steps = ["\n" + answers_of(hardware), "\n" * 7, "\n", "\n" * 4, "\n\n", "\n" + "\n\n\np" + "\n" * (len(grid()) - 2),
             "p\n" + "n\n" + "\n"]  # fmt: skip
    done = setup_command(folder, "".join(steps), "--simulate", "--seed", "5")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "not done:" not in done.stdout
    told = json.loads((folder / "out" / "setup.json").read_text())
    assert told["finished"] and set(told["done"]) == {step.name for step in STEPS}
    assert "expected error at the eye" in told["done"]["calibration"]["text"]
    settings = load_settings(folder / "new.toml")
    for index, panel in enumerate(settings.output.panels):
        monitor = hardware.order.index(index)
        assert (panel.edid_serial, panel.rotation_deg, panel.mirror) == (f"S{monitor}", *hardware.mounted[monitor])
    found = load_calibration(Path(settings.calibration.file)).stack_from_sensor
    eyes = np.array([viewpoint.midpoint_m for viewpoint in grid()])
    sensor = np.column_stack([eyes, np.ones(27)]) @ np.linalg.inv(demo_stack_from_sensor()).T
    assert np.linalg.norm((sensor @ found.T)[:, :3] - eyes, axis=1).mean() < 0.002
    there = shutil.copytree(folder / "out" / "service", tmp_path / "etc")  # the service's folder is self-contained
    settings = load_settings(there / "phasestack.toml")
    assert Path(settings.calibration.file) == there / "calibration.toml"
    assert [Path(panel.lut) for panel in settings.output.panels] == [there / f"panel-{n}.csv" for n in range(3)]
    assert str(folder) not in (there / "phasestack.toml").read_text()


def scripted(tmp_path: Path, lines: list[str], keys: Sequence[Key] = (), kind: type = SimulatedHardware) -> Setup:
    """Setup with given lines and keys, without a terminal; `setup.say.__self__` holds its output."""
    pressed, typed, said = iter(keys), iter(lines), list[str]()
    hardware = kind(lambda: next(pressed, Key.QUIT), STACK, say=said.append, seed=1)
    return Setup(tmp_path / "c.toml", tmp_path / "out", hardware, said.append, lambda: next(typed, "q"))


def test_as_root_the_last_step_installs_files_and_keeps_the_old_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    setup, installed = scripted(tmp_path, []), tmp_path / "etc"
    setup.hardware.simulated = False
    monkeypatch.setattr("calib.setup_steps.SERVICE_FOLDER", str(installed))
    monkeypatch.setattr("os.geteuid", lambda: 0)
    (tmp_path / "systemctl").write_text(f'#!/bin/sh\necho "$@" >> {tmp_path}/asked\n')
    (tmp_path / "systemctl").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    for width_px in (640, 1280):
        (tmp_path / "c.toml").write_text(f"[stack]\nwidth_px = {width_px}\nheight_px = {width_px * 9 // 16}\n")
        assert "installed" in service(setup)["text"]
    assert load_settings(installed / "phasestack.toml").stack.width_px == 1280
    assert "width_px = 640" in (installed / "phasestack.toml.~1~").read_text()
    assert (tmp_path / "asked").read_text() == "enable phasestack\nrestart phasestack\n" * 2


def test_a_step_that_is_done_is_where_it_goes_on_after(tmp_path: Path) -> None:
    assert not walk_through(scripted(tmp_path, ["n", *[""] * 7, "q"]))
    done = read_progress(progress_path(tmp_path / "c.toml"))
    assert list(done) == ["geometry"]
    second = scripted(tmp_path, ["n", "n", "p", "q"])
    second.done.update(done)
    walk_through(second)
    shown = [text.splitlines() for text in second.say.__self__ if text.startswith("\nStep")]
    assert [lines[1][:11] for lines in shown] == ["Step 1 of 7", "Step 2 of 7", "Step 3 of 7", "Step 2 of 7"]
    assert shown[1][-1] == "(already done)"


def test_sizes_are_typed_and_measured_distances_stay(tmp_path: Path) -> None:
    config = tmp_path / "c.toml"
    config.write_text("[stack]\nx_m = [-0.0601, 0.0, 0.0593]  # measured\n")
    setup = scripted(tmp_path, ["344.2", "much", "193.6"] + [""] * 4)
    geometry(setup)
    found = load_settings(config).stack
    assert (found.width_m, found.height_m) == pytest.approx((0.3442, 0.1936))
    assert found.x_m == (-0.0601, 0.0, 0.0593)
    assert "much is not a number; try again" in setup.say.__self__
    with pytest.raises(InputError, match="height_m"):
        geometry(scripted(tmp_path, ["", "-3"] + [""] * 4))
    geometry(scripted(tmp_path, ["", "", "58.7"] + [""] * 3))
    assert load_settings(config).stack.x_m == pytest.approx((-0.0587, 0.0, 0.0587))


def test_a_display_that_is_not_there_has_no_photographs_and_says_so(tmp_path: Path) -> None:
    setup = scripted(tmp_path, ["y", "n", "n", "n"])
    setup.hardware._photos = tmp_path / "none"
    with pytest.raises(SetupStopped):
        grey(setup)
    assert any("grey-0" in said and "the display is simulated" in said for said in setup.say.__self__)


class FourMonitors(SimulatedHardware):
    """Two of which have the same serial, and one has none."""

    shown: tuple[int, ...] = ()

    def monitors(self) -> tuple[Monitor, ...]:
        serials = enumerate(("S", "T", "T", ""))
        return tuple(Monitor(f"HDMI-{n}", serial, "", 100 * n, 0, 100, 50, 60.0) for n, serial in serials)

    def show_card(self, number: int, words: Sequence[str]) -> None:
        self.shown = (*self.shown, number)


def test_a_monitor_is_named_by_its_serial_and_keeps_its_settings(tmp_path: Path) -> None:
    taken = [Key.ACCEPT, Key.UP, Key.ACCEPT]
    keys = [Key.ACCEPT, Key.DOWN, Key.NEXT, *taken, Key.NEXT, *taken]
    identify(setup := scripted(tmp_path, [], keys, FourMonitors))
    assert setup.hardware.shown == (0, 0, 0, 1, 1, 1, 2, 3, 3, 3)
    config = tmp_path / "c.toml"
    config.write_text(config.read_text().replace('mirror = "', 'gamma = 2.0\nmirror = "'))
    identify(scripted(tmp_path, [], keys, FourMonitors))
    panels = load_settings(config).output.panels
    assert [panel.edid_serial or panel.connector for panel in panels] == ["S", "HDMI-1", "HDMI-3"]
    assert [(panel.rotation_deg, panel.gamma) for panel in panels] == [(180, 2.0), (0, 2.0), (0, 2.0)]
    assert panels[0].mirror != "none"


def test_progress_that_is_not_ours_is_refused(tmp_path: Path) -> None:
    (tmp_path / "c.setup.json").write_text("[]")
    with pytest.raises(InputError, match=r"c\.setup\.json: done"):
        read_progress(progress_path(tmp_path / "c.toml"))


def test_nothing_is_asked_of_a_terminal_that_is_closed(tmp_path: Path) -> None:
    done = setup_command(tmp_path, "", "--simulate")
    assert done.returncode == 0 and "not done: identify" in done.stdout and list(tmp_path.iterdir()) == []


def test_rewriting_a_configuration_widens_no_permission_and_keeps_links(tmp_path: Path) -> None:
    """The file holds a camera's password: setup once changed 0600 to 0644 and replaced the link by a copy."""
    (tmp_path / "kept").mkdir()
    config, link = tmp_path / "kept" / "display.toml", tmp_path / "phasestack.toml"
    config.write_text('[content]\nscene = "rtsp://user:secret@cam/1"\n')  # pragma: allowlist secret
    config.chmod(0o600)
    link.symlink_to(config)
    past = rewrite(link, lambda document: put(document, "calibration", {"viewing_m": [0.4, 0.7]}))
    assert link.is_symlink() and "viewing_m" in config.read_text()
    assert past is not None and past.parent == config.parent
    assert [stat.S_IMODE(path.stat().st_mode) for path in (config, past)] == [0o600, 0o600]
