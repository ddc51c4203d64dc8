"""`phasestack setup`: every key of a scripted terminal, from nothing to a configuration that a run is right with."""

from __future__ import annotations

import json
import os
import pty
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from calib.hardware import SimulatedHardware
from calib.keys import Key
from calib.setup_run import progress_path, read_progress, walk_through
from calib.setup_steps import STEPS, Setup, geometry, identify, service
from calib.viewpoints import grid
from runtime.config import Settings, load_settings
from runtime.errors import InputError
from runtime.eyes.calibration import load_calibration
from runtime.eyes.demo_geometry import demo_stack_from_sensor
from runtime.panels.monitors import Monitor

STACK = Settings().stack.stack()
SetUp = tuple[Path, subprocess.CompletedProcess[str], SimulatedHardware]
UP, DOWN, RIGHT, LEFT = "\x1b[A", "\x1b[B", "\x1b[C", "\x1b[D"


def simulated(seed: int) -> SimulatedHardware:
    return SimulatedHardware(lambda: None, STACK, say=lambda text: None, seed=seed)


def answers_of(hardware: SimulatedHardware) -> str:
    """The keys of a person who looks at a simulated display's cards, rear to front."""
    keys, shown, taken = "", 0, []
    for panel in range(len(hardware.order)):
        wanted = hardware.order.index(panel)
        while shown != wanted:
            keys += "n"
            shown = (shown + 1) % len(hardware.order)
            while shown in taken:
                shown = (shown + 1) % len(hardware.order)
        rotation_deg, mirror = hardware.mounted[wanted]
        keys += "\n" + (DOWN if rotation_deg else UP) + ("n" if mirror != "none" else "\n")
        taken.append(wanted)
        while len(taken) < len(hardware.order) and shown in taken:
            shown = (shown + 1) % len(hardware.order)
    return keys


def every_key(seed: int) -> str:
    hardware = simulated(seed)
    steps = [
        "\n" + answers_of(hardware),
        "\n" + DOWN + RIGHT + LEFT + "\n",
        "\n",
        "\n" + "\n" * len(STACK.x_m),
        "\n\n",
        "\n" + "\n\n\np" + "\n" * (len(grid()) - 2),
        "p" + "n" + "\n",
    ]
    return "".join(steps)


def setup_command(folder: Path, keys: str, *options: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "runtime.cli", "setup", "--config", "new.toml", "--out", "out", *options]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"}
    return subprocess.run(
        command, input=keys, cwd=folder, env=environment, capture_output=True, text=True, timeout=1700, check=False
    )


@pytest.fixture(scope="module")
def set_up(tmp_path_factory: pytest.TempPathFactory) -> SetUp:
    folder = tmp_path_factory.mktemp("setup")
    done = setup_command(folder, every_key(5), "--simulate", "--seed", "5")
    return folder, done, simulated(5)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_keys_alone_lead_from_nothing_to_a_configuration_that_is_valid(set_up: SetUp) -> None:
    folder, done, _ = set_up
    assert done.returncode == 0, done.stdout + done.stderr
    assert "step calibration: done" in done.stdout
    assert "not done:" not in done.stdout
    load_settings(folder / "new.toml")
    told = json.loads((folder / "out" / "setup.json").read_text())
    assert told["finished"]
    assert set(told["done"]) == {step.name for step in STEPS}
    assert "mm of error expected at the eye" in told["done"]["calibration"]["text"]
    assert told["done"]["calibration"]["text"] in done.stdout


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_panels_are_bound_as_they_are_mounted_and_the_sensor_is_found_where_it_stands(set_up: SetUp) -> None:
    folder, _, hardware = set_up
    settings = load_settings(folder / "new.toml")
    for index, panel in enumerate(settings.output.panels):
        monitor = hardware.order.index(index)
        assert panel.edid_serial == f"S{monitor}"
        assert (panel.rotation_deg, panel.mirror) == hardware.mounted[monitor]
    found = load_calibration(Path(settings.calibration.file)).stack_from_sensor
    eyes = np.array([viewpoint.midpoint_m for viewpoint in grid()])
    sensor = np.column_stack([eyes, np.ones(27)]) @ np.linalg.inv(demo_stack_from_sensor()).T
    assert np.linalg.norm((sensor @ found.T)[:, :3] - eyes, axis=1).mean() < 0.002


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_what_the_service_reads_is_gathered_and_stands_by_itself(set_up: SetUp, tmp_path: Path) -> None:
    folder, _, _ = set_up
    there = shutil.copytree(folder / "out" / "service", tmp_path / "etc")
    settings = load_settings(there / "phasestack.toml")
    assert Path(settings.calibration.file) == there / "calibration.toml"
    assert [Path(panel.lut) for panel in settings.output.panels] == [there / f"panel-{n}.csv" for n in range(3)]
    load_calibration(Path(settings.calibration.file))
    assert str(folder) not in (there / "phasestack.toml").read_text()


class Scripted:
    """A setup whose keys are given, without a terminal."""

    def __init__(self, tmp_path: Path, keys: list[Key]) -> None:
        self.said: list[str] = []
        pressed = iter(keys)
        self.hardware = SimulatedHardware(lambda: next(pressed, Key.QUIT), STACK, say=self.said.append, seed=1)
        self.setup = Setup(tmp_path / "c.toml", tmp_path / "out", self.hardware, self.said.append)


def test_as_root_the_last_step_applies_what_was_made_and_keeps_the_files_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scripted, installed = Scripted(tmp_path, []), tmp_path / "etc"
    scripted.hardware.simulated = False
    monkeypatch.setattr("calib.setup_steps.SERVICE_FOLDER", str(installed))
    monkeypatch.setattr("os.geteuid", lambda: 0)
    (tmp_path / "systemctl").write_text(f'#!/bin/sh\necho "$@" >> {tmp_path}/asked\n')
    (tmp_path / "systemctl").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    for width_px in (640, 1280):
        (tmp_path / "c.toml").write_text(f"[stack]\nwidth_px = {width_px}\nheight_px = {width_px * 9 // 16}\n")
        assert "applied" in service(scripted.setup)["text"]
    assert load_settings(installed / "phasestack.toml").stack.width_px == 1280
    assert "width_px = 640" in (installed / "phasestack.toml.~1~").read_text()
    assert (tmp_path / "asked").read_text() == "enable phasestack\nrestart phasestack\n" * 2


def test_a_step_that_is_done_is_where_it_goes_on_after(tmp_path: Path) -> None:
    first = Scripted(tmp_path, [Key.NEXT, Key.ACCEPT, Key.ACCEPT, Key.QUIT])
    assert not walk_through(first.setup)
    done = read_progress(progress_path(tmp_path / "c.toml"))
    assert list(done) == ["geometry"]
    second = Scripted(tmp_path, [Key.NEXT, Key.NEXT, Key.PREVIOUS, Key.QUIT])
    second.setup.done.update(done)
    walk_through(second.setup)
    shown = [text.splitlines()[1][:11] for text in second.said if text.startswith("\nStep")]
    assert shown == ["Step 1 of 7", "Step 2 of 7", "Step 3 of 7", "Step 2 of 7"]
    assert "(done before)" in second.said[1]


def test_a_step_that_is_stopped_writes_nothing_and_is_offered_again(tmp_path: Path) -> None:
    scripted = Scripted(tmp_path, [Key.ACCEPT, Key.ACCEPT, Key.QUIT, Key.QUIT])
    assert not walk_through(scripted.setup)
    assert not (tmp_path / "c.toml").exists()
    assert any("what was not finished is not written" in text for text in scripted.said)
    assert len([text for text in scripted.said if text.startswith("\nStep 1")]) == 2


def test_sizes_are_set_with_arrows_and_measured_distances_stay(tmp_path: Path) -> None:
    config = tmp_path / "c.toml"
    config.write_text("[stack]\nx_m = [-0.0601, 0.0, 0.0593]  # measured\n")
    keys = [Key.COARSER, Key.RIGHT, Key.DOWN, Key.FINER, Key.LEFT, Key.ACCEPT]
    geometry(Scripted(tmp_path, keys).setup)
    found = load_settings(config).stack
    assert (found.width_m, found.height_m) == pytest.approx((0.5194, 0.2915))
    assert found.x_m == (-0.0601, 0.0, 0.0593)
    geometry(Scripted(tmp_path, [Key.DOWN, Key.DOWN, Key.LEFT, Key.ACCEPT]).setup)
    assert load_settings(config).stack.x_m == pytest.approx((-0.0587, 0.0, 0.0587))


def test_an_answer_about_a_panel_can_be_taken_back_alone(tmp_path: Path) -> None:
    wrong = [Key.ACCEPT, Key.UP, Key.UNDO, Key.DOWN, Key.NEXT]  # the arrow, before the writing; and the writing, after
    pressed = [*wrong, Key.UNDO, Key.ACCEPT, *[Key.ACCEPT, Key.UP, Key.ACCEPT] * 2]
    identify(Scripted(tmp_path, pressed).setup)
    panels = load_settings(tmp_path / "c.toml").output.panels
    assert [(panel.rotation_deg, panel.mirror) for panel in panels] == [(180, "none"), (0, "none"), (0, "none")]


def test_sizes_are_typed_seen_before_they_are_right_and_taken_back(tmp_path: Path) -> None:
    digits = {**{str(n): Key[f"DIGIT_{n}"] for n in range(10)}, ".": Key.POINT}
    typed = [*(digits[c] for c in "3445"), Key.UNDO, digits["."], digits["2"]]
    height = [Key.DOWN, *(digits[c] for c in "99999"), Key.ACCEPT, *(digits[c] for c in "193.6"), Key.ACCEPT]
    scripted = Scripted(tmp_path, [*typed, Key.ACCEPT, *height, Key.RIGHT, Key.UNDO, Key.ACCEPT])
    geometry(scripted.setup)
    found = load_settings(tmp_path / "c.toml").stack
    assert (found.width_m, found.height_m) == pytest.approx((0.3442, 0.1936))
    assert any("its height is between 20.0 mm and 5000.0 mm" in said for said in scripted.said)
    last = scripted.said[-1]
    for shown in ("344.2 mm", "193.6 mm", "60.0 mm", "viewer", "Enter: all are right"):
        assert shown in last


def test_panels_already_known_keep_their_registration_when_they_are_identified_again(tmp_path: Path) -> None:
    hardware = simulated(1)
    meanings = {"\n": Key.ACCEPT, "n": Key.NEXT, UP: Key.UP, DOWN: Key.DOWN}
    keys, rest = [], answers_of(hardware)
    while rest:
        piece = rest[:3] if rest.startswith("\x1b") else rest[:1]
        keys, rest = [*keys, meanings[piece]], rest[len(piece) :]
    identify(Scripted(tmp_path, keys).setup)
    config = tmp_path / "c.toml"
    text = config.read_text().replace('mirror = "', 'gamma = 2.0\nmirror = "')
    config.write_text(text)
    identify(Scripted(tmp_path, keys).setup)
    assert [panel.gamma for panel in load_settings(config).output.panels] == [2.0, 2.0, 2.0]


class FourMonitors(SimulatedHardware):
    """Two of which have the same serial, and one has none."""

    def monitors(self) -> tuple[Monitor, ...]:
        self.shown: list[int] = []
        return tuple(
            Monitor(f"HDMI-{n}", serial, "", 100 * n, 0, 100, 50, 60.0) for n, serial in enumerate(("S", "T", "T", ""))
        )

    def show_card(self, number: int, words: Sequence[str]) -> None:
        self.shown.append(number)


def test_a_monitor_is_named_by_a_serial_of_its_own_and_an_answer_can_be_taken_back(tmp_path: Path) -> None:
    taken = [Key.ACCEPT, Key.UP, Key.ACCEPT]
    back = [Key.UNDO] * 3  # its writing, its arrow, whether it is the one
    pressed = iter([Key.NEXT, *taken, *[Key.NEXT] * 3, *back, *[Key.NEXT] * 3, *taken * 3])
    hardware = FourMonitors(lambda: next(pressed), STACK, say=lambda text: None)
    identify(Setup(tmp_path / "c.toml", tmp_path / "out", hardware, lambda text: None))
    assert hardware.shown[:10] == [0, 1, 1, 1, 2, 3, 0, 2, 1, 1], "what is taken is not offered, until it is taken back"
    panels = load_settings(tmp_path / "c.toml").output.panels
    assert [panel.edid_serial or panel.connector for panel in panels] == ["S", "HDMI-1", "HDMI-2"]


def test_progress_that_is_not_ours_is_refused(tmp_path: Path) -> None:
    (tmp_path / "c.setup.json").write_text("[]")
    with pytest.raises(InputError, match=r"c\.setup\.json: done"):
        read_progress(progress_path(tmp_path / "c.toml"))


def processor_s(process: int) -> float:
    """Processor time that a process has used."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def test_a_simulated_card_is_shown_in_the_terminal_and_waiting_for_a_key_is_no_work(tmp_path: Path) -> None:
    terminal, other_end = pty.openpty()
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "TERM": "xterm-256color"}
    command = [sys.executable, "-m", "runtime.cli", "setup", "--simulate"]
    with subprocess.Popen(
        command, stdin=other_end, stdout=other_end, stderr=other_end, cwd=tmp_path,
        env=environment | {"COLORTERM": "truecolor"},
    ) as running:  # fmt: skip
        try:
            shown = b""
            for wanted, key in ((b"Step 1 of 7", b"\n"), (b"simulated: it is panel", b"")):
                while wanted not in shown:
                    shown += os.read(terminal, 65536)
                os.write(terminal, key)
            assert shown.count("▀".encode()) > 1000
            before = processor_s(running.pid)
            time.sleep(1)
            assert processor_s(running.pid) - before < 0.2
            os.write(terminal, b"qq")
            assert running.wait(timeout=60) == 0
        finally:
            running.kill()
            os.close(other_end)
            os.close(terminal)


def test_nothing_is_asked_of_a_terminal_that_is_closed(tmp_path: Path) -> None:
    done = setup_command(tmp_path, "", "--simulate")
    assert done.returncode == 0
    assert "not done: identify" in done.stdout
    assert list(tmp_path.iterdir()) == []
