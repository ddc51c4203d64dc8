"""Noise is told from motion, and drift does not add up."""

from __future__ import annotations

import numpy as np
import pytest

from runtime.plan.reuse import ReuseGate, lateral_shift_m

EYES = np.array([[0.6, -0.03, 0.05], [0.6, 0.03, 0.05]])
TURN_NS = 16_666_667


def run(gate: ReuseGate, path: np.ndarray, start: int = 0) -> list[bool]:
    """True for each turn that was reused; whatever was not is solved for."""
    reused = []
    for turn, eyes in enumerate(path):
        good = gate.may_reuse(eyes, time_ns=(start + turn) * TURN_NS)
        if not good:
            gate.solved(gate.best_guess(eyes))
        reused.append(good)
    return reused


def noise(turns: int, sigma_m: float, seed: int = 0, correlation: float = 0.8) -> np.ndarray:
    """What a filter leaves of a sensor's noise: correlated from turn to turn, larger along the gaze."""
    random = np.random.default_rng(seed)
    white = random.normal(0, 1, (turns, 2, 3))
    out = np.zeros_like(white)
    for turn in range(1, turns):
        out[turn] = correlation * out[turn - 1] + np.sqrt(1 - correlation**2) * white[turn]
    return out * sigma_m * [2.0, 1.0, 1.0]


@pytest.mark.parametrize("sigma_mm", [0.1, 0.3, 0.5])
@pytest.mark.parametrize("seed", range(8))
def test_a_still_head_costs_next_to_nothing_after_the_first_second(sigma_mm: float, seed: int) -> None:
    reused = run(ReuseGate(most_m=0.001), EYES + noise(1200, sigma_mm / 1000, seed))
    assert np.mean(reused[60:]) > 0.99


def test_an_estimate_that_noise_threw_off_is_not_solved_for() -> None:
    gate = ReuseGate(most_m=0.001)
    run(gate, EYES + noise(120, 0.0004))
    aside = EYES + np.array([0.0, 0.0014, 0.0])
    gate.may_reuse(aside, time_ns=121 * TURN_NS)
    assert lateral_shift_m(gate.best_guess(aside), EYES) < 0.0004
    assert lateral_shift_m(gate.best_guess(EYES + np.array([0.0, 0.005, 0.0])), EYES) == pytest.approx(0.005)


def test_motion_is_followed_at_once() -> None:
    gate = ReuseGate(most_m=0.001)
    run(gate, EYES + noise(120, 0.0002))
    jump = EYES + np.array([0.0, 0.005, 0.0])
    assert not gate.may_reuse(jump, time_ns=121 * TURN_NS)


@pytest.mark.parametrize("speed_m_per_s", [0.01, 0.05, 0.2])
def test_a_moving_head_is_never_shown_a_picture_from_further_away_than_the_band_and_its_noise(
    speed_m_per_s: float,
) -> None:
    gate = ReuseGate(most_m=0.001)
    turns = np.arange(600)
    path = EYES + noise(600, 0.0002) + (turns * TURN_NS * 1e-9 * speed_m_per_s)[:, None, None] * [0.0, 1.0, 0.0]
    shown, worst = None, 0.0
    for turn, eyes in enumerate(path):
        if not gate.may_reuse(eyes, time_ns=turn * TURN_NS):
            shown = gate.best_guess(eyes)
            gate.solved(shown)
        assert shown is not None
        worst = max(worst, lateral_shift_m(shown, eyes))
    assert worst < 0.0025


def test_slow_drift_does_not_add_up() -> None:
    gate = ReuseGate(most_m=0.001)
    path = EYES + np.arange(2000)[:, None, None] * np.array([0.0, 0.00001, 0.0])  # 2 cm in all
    reused = run(gate, path)
    assert reused.count(False) > 10


def test_a_step_towards_the_display_counts_as_far_as_it_changes_what_is_seen() -> None:
    ahead = np.array([[0.6, 0.0, 0.0], [0.6, 0.0, 0.0]])
    assert lateral_shift_m(ahead, ahead + np.array([0.05, 0.0, 0.0])) == 0.0
    assert lateral_shift_m(ahead, ahead + np.array([0.0, 0.003, 0.004])) == pytest.approx(0.005)


def test_a_fixed_band_is_kept_and_forgetting_solves_again() -> None:
    gate = ReuseGate(most_m=0.001, band_m=0.0005)
    run(gate, EYES + noise(100, 0.0004))
    assert gate.band_m == 0.0005
    assert gate.may_reuse(EYES, time_ns=101 * TURN_NS) in (True, False)
    gate.forget()
    assert not gate.may_reuse(EYES, time_ns=102 * TURN_NS)
