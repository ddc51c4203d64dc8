"""Tests a recorded run end to end, with a simulated clock and offscreen panels."""

from __future__ import annotations

import hashlib
import json
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from runtime.clock import NS_PER_S
from runtime.commands.app import app
from runtime.config import Settings, with_options
from runtime.daemon import supervise
from runtime.daemon.build import RunOptions
from runtime.daemon.drive import drive, headline_lines
from runtime.errors import InputError
from runtime.evaluation.run_output import RunOutput
from runtime.eyes.calibration import demo_sensor_from_stack
from runtime.eyes.motions import true_eyes
from runtime.panels.registry import OffscreenPanels
from runtime.records import EyePoints, SensorFrame
from runtime.sensor.recording import Recording, recording_to
from runtime.sensor.recording_format import RecordingHeader
from runtime.sensor.replay import demo_recording_path
from runtime.support.picture_file import read_image
from tests.test_cli import phasestack, refusal
from tests.waiting import PATIENT

FRAMES = 60
LAYERS = ("layer-0.png", "layer-1.png", "layer-2.png")
VIEWS = ("seen-left.png", "seen-right.png", "wanted-left.png", "wanted-right.png")
PICTURES = (*LAYERS, *VIEWS, "contact-sheet.png", "viewer.html")
REFRESH_STAGES = {"sensor", "track", "present", "wait"}
SOLVING_STAGES = {"render", "prepare", "inference", "finish"}


def files_of(folder: Path) -> dict[str, str]:
    """Digest of every file in a folder."""
    paths = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in paths}


def lines_of(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "frames.jsonl").read_text().splitlines()]


def summary_of(folder: Path) -> dict[str, Any]:
    result: dict[str, Any] = json.loads((folder / "summary.json").read_text())
    return result


def run(folder: Path, *arguments: Any) -> Path:
    """A run as fast as it can, whose files are in `folder`."""
    result = phasestack("run", "--headless", "--max-speed", *map(str, arguments), "--out", str(folder))
    assert result.returncode == 0, result.stderr
    return folder


def played(folder: Path, recording: Path | str, *, scale: float = 0.05, frames: int | None = None) -> Path:
    """Run a recording in this process; returns the folder."""
    options = RunOptions(max_speed=True, measure=True, scale=scale, frames=frames, out=folder)
    drive(with_options(Settings(), replay=str(recording), headless=True), options)
    return folder


def recorded(path: Path, times_s: Any, *, motion: str = "lean") -> Path:
    """A head with 2 mm of noise, sampled at these times; the truth is in the file."""
    times_s = np.asarray(times_s, float)
    truth, random = true_eyes(motion, times_s - times_s[0]), np.random.default_rng(7)
    sensor_from_stack = demo_sensor_from_stack()
    with recording_to(path, RecordingHeader(driver="test", serial="demo")) as writer:
        for number, (time_s, eyes_m) in enumerate(zip(times_s, truth, strict=True), start=1):
            seen = eyes_m + random.normal(0.0, 0.002, (2, 3))
            points = EyePoints(seen @ sensor_from_stack[:3, :3].T + sensor_from_stack[:3, 3], np.ones(2))
            assert writer.write(SensorFrame(number, round(time_s * NS_PER_S), points, true_eyes_m=eyes_m))
    return path


def evenly(rate_hz: float, seconds: float, *, start_s: float = 1.0) -> np.ndarray:
    return start_s + np.arange(round(rate_hz * seconds)) / rate_hz


DEMO = ("--replay", "demo", "--frames", FRAMES, "--scale", 0.1, "--keep-light", 15)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, Path]]:
    """Two identical runs."""
    folders = tmp_path_factory.mktemp("runs")
    yield run(folders / "a", *DEMO), run(folders / "b", *DEMO)


def test_two_runs_at_full_speed_are_identical_in_every_byte(runs: tuple[Path, Path]) -> None:
    files = files_of(runs[0])
    assert files == files_of(runs[1])
    assert {*PICTURES, "frames.jsonl", "summary.json"} <= set(files)


def test_every_refresh_is_presented_and_none_waits_for_a_solution(runs: tuple[Path, Path]) -> None:
    summary = summary_of(runs[0])
    assert summary["frames"] == summary["presented"] == FRAMES
    assert summary["dropped"] == 0
    assert summary["fps"] == pytest.approx(60.0)
    assert summary["interval_ms"] == {"p50": pytest.approx(16.667, abs=0.01), "p99": pytest.approx(16.667, abs=0.01)}
    # 23 ms a solution: begun with a refresh, ready at the one after the next.
    assert summary["inferences"] == pytest.approx(FRAMES / 1.5, rel=0.2)
    assert summary["states"].keys() >= {"tracking"}


def test_the_summary_has_figures_and_null_where_nothing_was_measured(runs: tuple[Path, Path], tmp_path: Path) -> None:
    summary = summary_of(runs[0])
    assert set(summary["stage_ms"]) == REFRESH_STAGES | SOLVING_STAGES
    assert set(summary["stage_ms"]["render"]) == {"p50", "p95", "p99", "max"}
    for name in ("live_db", "psnr_db", "ssim", "carried_db", "carried_db_true_eyes", "psnr_db_true_eyes"):
        assert summary[name] is not None, name
    assert summary["clock"] == "simulated" and summary["view_error_mm"].keys() == {"p50", "p95"}
    assert summary["carried_db"] > 20
    short = summary_of(played(tmp_path / "first", "demo", frames=1))
    for name in ("live_db", "view_error_mm", "psnr_db", "carried_db", "fps", "interval_ms", "photon_ms", "overhead_ms"):
        assert short[name] is None, name


def test_what_a_line_tells_agrees_with_the_lines_before_it(runs: tuple[Path, Path]) -> None:
    lines = lines_of(runs[0])
    assert [line["frame"] for line in lines] == list(range(FRAMES))
    shown = None
    for line in lines:
        assert line["eyes_label"] in {"exact", "interpolated", "predicted", "held", "rested", "none"}
        assert line["inference"] in {"ran", "reused", "skipped"}
        assert (line["inference"] == "ran") == (line["solution"] is not None and line["solution"] != shown)
        assert (line["inference"] == "skipped") == (line["solution"] is None)
        assert set(line["stage_ms"]) == REFRESH_STAGES | (SOLVING_STAGES if line["inference"] == "ran" else set())
        shown = line["solution"] if line["solution"] is not None else shown
        if line["solution"] is not None:
            assert np.shape(line["solved_for_m"]) == (2, 3)
        if line["eyes_m"] is not None:
            assert np.shape(line["eyes_m"]) == (2, 3)
            assert line["eye_sigma_mm"] > 0
            assert line["predicted_for_ns"] > line["capture_ns"]


def known(folder: Path) -> list[dict[str, Any]]:
    """Lines with known truth when the run ended: all but those of the last few samples."""
    lines = lines_of(folder)
    newest_ns = max(line["capture_ns"] for line in lines)
    told = [line for line in lines if line["true_eyes_m"] is not None]
    assert [line["frame"] for line in told[-1:]] >= [
        max(n["frame"] for n in lines if n["predicted_for_ns"] <= newest_ns)
    ]
    return told


def test_true_eyes_are_those_at_the_light(runs: tuple[Path, Path]) -> None:
    samples = list(Recording(demo_recording_path()).samples())
    began_ns = samples[0].capture_ns
    times_s = [(sample.capture_ns - began_ns) / NS_PER_S for sample in samples]
    of_the_demo = CubicSpline(times_s, [sample.true_eyes_m for sample in samples])
    for line in known(runs[0])[5:]:
        expected = of_the_demo(line["predicted_for_ns"] / NS_PER_S)
        assert np.abs(np.array(line["true_eyes_m"]) - expected).max() < 0.0005


def test_kept_light_is_what_the_panels_show_with_what_the_judge_needs(runs: tuple[Path, Path]) -> None:
    lines = {line["frame"]: line for line in lines_of(runs[0])}
    kept = sorted(int(folder.name) for folder in (runs[0] / "light").iterdir())
    assert kept == [14, 29, 44, 59]
    for frame in kept:
        folder = runs[0] / "light" / str(frame)
        names = {path.name for path in folder.iterdir()}
        pictures = {f"{name}-{eye}.png" for name in ("drawn", "true") for eye in ("left", "right")}
        assert names == {*LAYERS, *pictures, "light.json"}
        told = json.loads((folder / "light.json").read_text())
        assert set(told) == {"solved_for_m", "eyes_m", "true_eyes_m", "fov", "people"}
        for name in ("solved_for_m", "eyes_m", "true_eyes_m", "people"):
            assert told[name] == lines[frame][name]
    last = read_image(runs[0] / "light" / "59" / "layer-0.png")
    assert np.array_equal(last, read_image(runs[0] / "layer-0.png"))  # the run's own last picture is the aligned one


def test_a_looping_recording_plays_once_at_maximum_speed(tmp_path: Path) -> None:
    recording, config = recorded(tmp_path / "head.mcap", evenly(60, 0.5)), tmp_path / "loop.toml"
    config.write_text(f'[sensor]\ndriver = "replay"\nsource = "{recording}"\nloop = true\n[model]\nname = "fast"\n')
    common = ("run", "--config", str(config), "--headless", "--scale", "0.05", "--max-speed", "--json")
    told = subprocess.run(
        [sys.executable, "-m", "runtime.cli", *common], check=True, timeout=120, capture_output=True, text=True
    )
    assert json.loads(told.stdout)["stopped"] == "the recording has ended"


SLOWEST_HZ, FASTEST_HZ = 15, 240


@pytest.mark.parametrize("rate_hz", [SLOWEST_HZ, 60, FASTEST_HZ])
def test_a_recording_of_any_rate_plays_once_and_repeatably(tmp_path: Path, rate_hz: int) -> None:
    recording = recorded(tmp_path / "head.mcap", evenly(rate_hz, 1.0))
    first = played(tmp_path / "a", recording)
    if rate_hz in (SLOWEST_HZ, FASTEST_HZ):  # those between differ in nothing that could be random
        assert files_of(first) == files_of(played(tmp_path / "b", recording))
    summary, lines = summary_of(first), lines_of(first)
    # From the first sample to the arrival of the last.
    assert summary["seconds"] == pytest.approx((rate_hz - 1) / rate_hz + 0.015, abs=0.02)
    assert summary["frames"] == summary["presented"] == pytest.approx(60 * summary["seconds"] + 1, abs=1)
    assert summary["stopped"] == "the recording has ended"
    # No slip: a refresh is as far behind its newest sample at the end as at the beginning.
    ages_ms = [(line["predicted_for_ns"] - line["capture_ns"]) / 1e6 for line in lines if line["capture_ns"]]
    assert np.median(ages_ms[-10:]) < np.median(ages_ms[:10]) + 1000 / rate_hz
    if rate_hz > 60:
        assert summary["stale_inputs"] > 0.3 * rate_hz


def test_a_gap_of_three_seconds_passes_holding_and_flat_once(tmp_path: Path) -> None:
    times = [*evenly(30, 0.7), *evenly(30, 0.7, start_s=4.7)]
    recording = recorded(tmp_path / "gap.mcap", times, motion="still")
    first = played(tmp_path / "a", recording)
    assert files_of(first) == files_of(played(tmp_path / "b", recording))
    lines = lines_of(first)
    assert states_passed(lines) == ["flat", "tracking", "holding", "flat", "tracking"]
    assert summary_of(first)["seconds"] == pytest.approx(3.7 + 0.7, abs=0.08)
    assert max(np.diff([line["present_ns"] for line in lines])) < 1.1 * NS_PER_S / 60
    gap = [line for line in lines if line["present_ns"] / NS_PER_S - lines[0]["present_ns"] / NS_PER_S > 2]
    assert gap[0]["eyes_m"] is None
    assert gap[0]["true_eyes_m"] is None  # not interpolated


def states_passed(lines: list[dict[str, Any]]) -> list[str]:
    """Each state once for each time that it was entered."""
    states = [line["state"] for line in lines]
    return [state for state, before in zip(states, [None, *states], strict=False) if state != before]


def test_real_and_simulated_time_pass_the_same_states(tmp_path: Path) -> None:
    """A viewer who comes, is lost for a while, and returns."""
    times = [*evenly(30, 0.8), *evenly(30, 0.8, start_s=3.4)]
    recording = recorded(tmp_path / "loss.mcap", times, motion="still")
    config = tmp_path / "phasestack.toml"
    config.write_text(
        f'[model]\nname = "fast"\nthreads = 1\nbackend = "cpu"\n[service]\nsocket = "{tmp_path / "status.sock"}"\n'
    )
    common = ("run", "--config", str(config), "--replay", str(recording), "--headless", "--scale", "0.05")
    passed = {}
    for name, more in (("simulated", ["--max-speed"]), ("real", [])):
        command = [sys.executable, "-c", PATIENT, *common, *more, "--verbose", "--out", str(tmp_path / name)]
        told = subprocess.run(command, check=True, timeout=120, capture_output=True, text=True).stdout
        assert ("not measured:" in told) == (name == "simulated") and "_db)" in told
        passed[name] = states_passed(lines_of(tmp_path / name))
    # In real time the sensor's first sample may be there before the first refresh, or not.
    assert passed["real"][-4:] == passed["simulated"][-4:] == ["tracking", "holding", "flat", "tracking"]
    assert set(passed["real"][:-4]) | set(passed["simulated"][:-4]) <= {"flat"}
    real, simulated = summary_of(tmp_path / "real"), summary_of(tmp_path / "simulated")
    assert real["seconds"] == pytest.approx(simulated["seconds"], abs=0.5)
    assert "fps" in simulated["configured"] and real["configured"] == [] and real["clock"] == "real"


def test_the_demo_ends_in_time_and_says_so_with_one_figure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("runtime.commands.demo.LONGEST_S", 0.0)
    monkeypatch.setattr("runtime.commands.demo.LEAST", 4)
    monkeypatch.setattr("runtime.daemon.drive.drive", lambda s, o, host: drive(s, replace(o, scale=0.1), host))
    with pytest.raises(SystemExit):
        app(["demo", "--out", str(tmp_path)])
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["frames"] == 4 and summary["light_db"]
    assert "time limit of 0 s ended the demo after 4 of 42 refreshes; --frames 600" in summary["stopped"]
    told = capsys.readouterr().out
    assert "ended      the time limit of 0 s ended the demo after 4 of 42 refreshes" in told and "4 of 42" in told
    assert len(re.findall(r"[\d.]+ dB|_db ", told)) == 1, "one figure of quality"
    assert re.search(r"\d steps? on (all pixels|half the rows and columns)", told) and "1/1+" not in told
    assert (summary["clock"], summary["scene"]) == ("simulated", "room")
    assert list(summary)[:2] == ["clock", "configured"]


def test_the_headline_names_three_efforts_and_sums_up_the_others() -> None:
    efforts = {"1/1+2": 6.0, "1/2+1": 0.2, "1/1+4": 3.0, "1/3+0": 0.3, "1/4+0": 0.5}
    summary = dict.fromkeys(("live_db", "light_db", "view_error_mm")) | {
        "inferences": 3, "configured": True, "dropped": 0, "presented": 9, "model": "fast", "backend": "cpu",
        "states": {"tracking": 10.0}, "stopped": "done", "efforts": efforts,
    }  # fmt: skip
    _, _, model, *_ = headline_lines(summary)
    assert [part.rpartition(" for ")[2] for part in model.split(", ")] == ["60%", "30%", "5%", "5%"]
    assert ", others for 5%" in model


def test_a_run_that_could_not_write_its_files_does_not_end_well(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(path: Path, data: Any) -> None:
        raise InputError(path, "", "cannot be written: No space left on device")

    monkeypatch.setattr("runtime.evaluation.run_output.write_json", full)
    told = refusal("demo", "--frames", "1", "--out", tmp_path / "out")
    assert told == f"{tmp_path / 'out' / 'summary.json'}: cannot be written: No space left on device"
    assert "contact-sheet.png" not in capsys.readouterr().out
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["frames.jsonl"], "what was complete stays"
    monkeypatch.setattr(supervise, "run_daemon", lambda *_: {"output_problem": "why"})
    assert refusal("run", "--json", "--out", tmp_path / "out") == "why"


def test_the_demo_recording_begins_anew_unless_it_is_told_how_long(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[Settings] = []

    def run_daemon(read_settings: Callable[[], Settings], options: RunOptions) -> dict[str, Any]:
        told.append(read_settings())
        return {"stopped": "at once"}

    monkeypatch.setattr(supervise, "run_daemon", run_daemon)
    for more in ([], ["--frames", "5"], ["--max-speed"], ["--out", str(tmp_path)]):
        app(["run", "--replay", "demo", "--headless", *more], standalone_mode=False)
    app(["run", "--replay", str(demo_recording_path()), "--headless"], standalone_mode=False)
    assert [settings.sensor.loop for settings in told] == [True, False, False, False, False]


def test_the_panels_are_dark_before_what_a_run_leaves_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    order: list[str] = []
    finish = RunOutput.finish
    monkeypatch.setattr(OffscreenPanels, "close", lambda panels: order.append("dark"))
    monkeypatch.setattr(RunOutput, "finish", lambda *given, **how: (order.append("written"), finish(*given, **how)))
    played(tmp_path / "out", "demo", frames=4)
    assert order[:2] == ["dark", "written"] and (tmp_path / "out" / "summary.json").is_file()
