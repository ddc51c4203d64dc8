"""The eyes' own separation as a ruler: what it tells of the sensor's metre, and what that is worth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calib.experiment import run_case
from calib.eye_separation import POPULATION_SIGMA_M, SeparationScale, joined, separation_scale
from calib.pairs import PairsFile, read_pairs
from calib.solution import solve_default
from calib.viewpoints import grid
from calib.walk import captured
from tests.calib.test_capture import eyes_at

IPD_M = 0.0625


def told(*, scale: float, noise_m: float, count: int = 27, seed: int = 0) -> np.ndarray:
    """Separations that a sensor tells whose metre is `scale` of ours, with noise in every coordinate of each eye."""
    eyes = np.random.default_rng(seed).normal(scale=noise_m, size=(count, 2, 3))
    return np.linalg.norm(eyes[:, 1] - eyes[:, 0] + [IPD_M / scale, 0, 0], axis=-1)


@pytest.mark.parametrize("scale", [0.95, 1.0, 1.1])
def test_exact_eyes_tell_the_scale_exactly(scale: float) -> None:
    found = separation_scale(told(scale=scale, noise_m=0.0), ipd_m=IPD_M, ipd_sigma_m=0.001)
    assert np.exp(found.log_scale) == pytest.approx(scale, rel=1e-9)
    assert found.sigma == pytest.approx(0.001 / IPD_M, rel=1e-6)


def test_noise_does_not_make_the_eyes_lie_farther_apart() -> None:
    many = [
        separation_scale(told(scale=1.0, noise_m=0.006, seed=seed), ipd_m=IPD_M, ipd_sigma_m=0.0005)
        for seed in range(200)
    ]
    assert abs(np.mean([one.log_scale for one in many])) < 0.008  # the mean distance alone is 1.8% too large
    assert np.std([one.log_scale for one in many]) == pytest.approx(np.mean([one.sigma for one in many]), rel=0.35)


def test_somebodys_eyes_lie_as_far_apart_as_most_peoples() -> None:
    found = separation_scale(told(scale=1.0, noise_m=0.001), ipd_m=0.0, ipd_sigma_m=0.001)
    assert found.sigma > POPULATION_SIGMA_M / 0.063 * 0.99


@pytest.mark.parametrize("separations", [np.empty(0), np.full(27, np.nan), np.full(4, 0.06)])
def test_too_few_tell_nothing(separations: np.ndarray) -> None:
    assert separation_scale(separations, ipd_m=IPD_M, ipd_sigma_m=0.001) is None


def test_two_estimates_are_weighed_by_their_certainty() -> None:
    logarithm, sigma = joined(0.02, 0.01, SeparationScale(0.0, 0.01))
    assert (float(logarithm), float(sigma)) == (pytest.approx(0.01), pytest.approx(0.01 / np.sqrt(2)))
    assert joined(0.02, 0.01, None) == (0.02, 0.01)


def test_eyes_that_are_known_make_the_default_better_where_pairs_are_noisy() -> None:
    """10 mm of noise, the sensor's metre 5% short: 26% worse than the best method becomes less than 8%."""
    without, known = (
        run_case(sigma_m=0.010, sensor_scale=0.95, separation_sigma_m=sigma, seeds=100).mean_m for sigma in (0.0, 0.001)
    )
    assert without["default"] > 1.15 * min(without.values())
    assert known["default"] < 1.08 * min(value for name, value in known.items() if name != "default")


def test_a_separation_that_agrees_changes_nothing_where_the_pairs_are_exact() -> None:
    stack = np.array([viewpoint.midpoint_m for viewpoint in grid()])
    sensor = np.array([eyes_at(place).eyes_m.mean(0) for place in stack])
    found = solve_default(sensor, stack, separation=SeparationScale(0.05, 0.06))
    assert found.similarity.scale == pytest.approx(1.0, abs=1e-9)


def test_the_file_of_pairs_keeps_what_the_sensor_told_of_the_eyes(tmp_path: Path) -> None:
    from calib.capture import EyeWindow

    window = EyeWindow(0.5)
    for number in range(15):
        window.add(number * 33_000_000, eyes_at(grid()[0].midpoint_m))
    file = PairsFile(tmp_path / "p.csv")
    file.accept(captured(window.measure(), grid()[0].midpoint_m, grid()[0].name))
    assert read_pairs(tmp_path / "p.csv").separation_m == pytest.approx([0.06])
    assert len(PairsFile(tmp_path / "p.csv")) == 1
    old = "\n".join(",".join(line.split(",")[:6]) for line in (tmp_path / "p.csv").read_text().splitlines())
    (tmp_path / "old.csv").write_text(old + "\n")
    assert np.isnan(read_pairs(tmp_path / "old.csv").separation_m).all()
