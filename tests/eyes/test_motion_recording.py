"""Tests that a recorded motion replays the samples of the tracker's benchmark."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from runtime.commands.record import record
from runtime.errors import InputError
from runtime.evaluation.motion_recording import write_motion
from runtime.eyes.calibration import demo_stack_from_sensor
from runtime.eyes.motions import MOTIONS, observe, path_of, true_eyes
from runtime.eyes.two_people import MOTIONS_OF_TWO
from runtime.sensor.recording import Recording
from tests.calls import answered, invoked


def truth_of(path: Path) -> NDArray[np.float64]:
    return np.array([frame.true_eyes_m for frame in Recording(path).samples()])


def test_samples_are_the_observations_through_the_demos_calibration(tmp_path: Path) -> None:
    write_motion(tmp_path / "walk.mcap", "walk", seconds=5.0)
    frames = list(Recording(tmp_path / "walk.mcap").samples())
    pose = demo_stack_from_sensor()
    for frame, seen in zip(frames, observe("walk", seconds=5.0, rate_hz=30.0), strict=True):
        assert frame.capture_ns == seen.capture_ns and (frame.eyes is None) == (seen.points is None)
        if frame.eyes is not None:
            place = frame.eyes.eyes_m @ pose[:3, :3].T + pose[:3, 3]
            np.testing.assert_allclose(place, seen.points.eyes_m, atol=1e-6)
    truth = true_eyes("walk", np.array([f.capture_ns for f in frames]) / 1e9)
    np.testing.assert_allclose([f.true_eyes_m for f in frames], truth, atol=1e-6)


@pytest.mark.parametrize("motion", MOTIONS)
def test_another_seed_is_another_path_and_not_only_other_noise(tmp_path: Path, motion: str) -> None:
    for seed in (1, 2):
        write_motion(tmp_path / f"{seed}.mcap", motion, seed=seed, seconds=4.0)
        write_motion(tmp_path / f"{seed}-again.mcap", motion, seed=seed, seconds=4.0)
        assert (tmp_path / f"{seed}.mcap").read_bytes() == (tmp_path / f"{seed}-again.mcap").read_bytes()
    apart = np.abs(truth_of(tmp_path / "1.mcap") - truth_of(tmp_path / "2.mcap")).max()
    assert apart > {"still": 0.001, "nod": 0.01}.get(motion, 0.05)


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("seed", range(9))
def test_every_path_is_a_motion_of_its_kind(motion: str, seed: int) -> None:
    eyes = true_eyes(motion, np.arange(0, 20, 1e-3), path=path_of(seed))
    np.testing.assert_allclose(np.linalg.norm(eyes[:, 1] - eyes[:, 0], axis=1), 0.063, atol=1e-9)
    speed = np.linalg.norm(np.diff(eyes.mean(1), axis=0), axis=1) / 1e-3
    most = {"still": 0.02, "lean": 0.5, "nod": 0.5, "walk": 1.9, "stop-and-go": 1.7}[motion]
    assert most / 20 < speed.max() < most and (eyes[:, :, 0] > 0.2).all()


@pytest.mark.parametrize("rate_hz", [15, 60, 240])
def test_the_command_makes_any_of_them(tmp_path: Path, rate_hz: int) -> None:
    out = tmp_path / "new" / "nod.mcap"
    how = ["--motion", "nod", "--seed", "7", "--rate-hz", str(rate_hz), "--noise-mm", "0", "--seconds", "2"]
    told = answered(record, *how, "--out", out)
    frames = list(Recording(out).samples())
    assert told["samples"] == len(frames) == 2 * rate_hz and told["seed"] == 7
    steps = np.diff([f.capture_ns for f in frames]) * rate_hz / 1e9
    np.testing.assert_allclose(steps, 1.0, atol=1e-6)
    pose = demo_stack_from_sensor()
    off = [np.abs(f.eyes.eyes_m @ pose[:3, :3].T + pose[:3, 3] - f.true_eyes_m).max() for f in frames if f.eyes]
    assert np.median(off) < 1e-6  # without noise, measurements equal the truth, except outliers


@pytest.mark.parametrize(("how", "names"), [
    (["--motion", "moonwalk"], "stop-and-go"), (["--motion", "walk", "--images"], "--images"),
    (["--seed", "3"], "--seed"), (["--motion", "walk", "--seconds", "1e9"], "--seconds"),
])  # fmt: skip
def test_what_makes_no_sense_is_refused_by_name_and_leaves_nothing(tmp_path: Path, how: list[str], names: str) -> None:
    answer = invoked(record, *how, "--out", tmp_path / "a.mcap")
    assert isinstance(answer.exception, InputError) and names in str(answer.exception)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("motion", MOTIONS_OF_TWO)
def test_two_people_are_recorded_nearest_first_each_where_they_are(tmp_path: Path, motion: str) -> None:
    write_motion(tmp_path / "two.mcap", motion, seconds=11.0, noise_mm=0.0)
    pose = demo_stack_from_sensor()
    seen_together, off_m = 0, []
    for sample in Recording(tmp_path / "two.mcap").samples():
        assert sample.true_eyes_m is not None and sample.true_eyes_m.shape == (4, 3)
        people = [person.eyes_m @ pose[:3, :3].T + pose[:3, 3] for person in sample.people]
        true_m = sample.true_eyes_m.reshape(2, 2, 3)
        seen_together += len(people) == 2
        off_m += [np.nanmin([np.abs(eyes_m - pair).max() for pair in true_m]) for eyes_m in people]
        if len(people) == 2 and max(off_m[-2:]) < 1e-5:  # an outlier may seem to be nearer
            nearest, other = (np.linalg.norm(eyes_m.mean(axis=0)) for eyes_m in people)
            assert nearest <= other + 1e-6
    assert seen_together > 60 and np.mean(np.array(off_m) < 1e-5) > 0.9
