"""What a moving viewer sees: the daemon's own loop on small panels, held and aligned."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from runtime.report.moving import (
    Light,
    moving_runs,
    record_motion,
    settings_for,
    simulated_run,
)

SCALE = 0.15


@pytest.fixture(scope="module")
def runs() -> Any:
    """One motion with a slow solver."""
    return moving_runs(motions=("lean",), solver_ms=(150.0,), seconds=2.5, scale=SCALE)


def test_an_aligned_picture_holds_where_a_held_one_falls_apart(runs: Any) -> None:
    held, aligned = runs[0]
    assert (held.aligned, aligned.aligned) == (False, True)
    assert held.lights == aligned.lights > 5
    assert aligned.carried_db > held.carried_db + 2
    # Both runs have the same tracker, which is nearer to the truth than the place that was solved for.
    assert held.tracker_mm == aligned.tracker_mm
    assert aligned.behind_mm > 2 * aligned.tracker_mm[0] > 0


def test_the_film_strip_shows_the_same_instants_both_ways(runs: Any) -> None:
    strip = runs[1]
    assert strip.held.shape == strip.aligned.shape == strip.wanted.shape
    assert len(strip.seconds) == len(strip.held) == len(strip.held_db) > 2
    assert np.mean(strip.aligned_db) > np.mean(strip.held_db)

    def apart(pictures: np.ndarray) -> float:
        return float(np.abs(pictures.astype(int) - strip.wanted).mean())

    assert apart(strip.aligned) < apart(strip.held)


def test_a_runs_solver_takes_as_long_as_it_is_told_and_its_truth_is_the_recordings(tmp_path: Path) -> None:
    recording = tmp_path / "walk.mcap"
    record_motion(recording, "walk", seconds=2.0, seed=3)
    settings = settings_for(recording, solver_ms=200.0, aligned=True)
    solving = ("render", "prepare", "inference", "finish")
    assert sum(settings.loop.simulated_stage_ms[stage] for stage in solving) == pytest.approx(200.0)
    lights: list[Light] = []
    watched = simulated_run(settings, scale=SCALE, keep_light=10, measure=lights.append)
    assert watched.summary["solutions_per_s"] < 6
    told = {line["frame"]: line for line in watched.lines}
    assert len(lights) > 5
    for light in lights:
        np.testing.assert_array_equal(light.true_eyes_m, told[light.frame]["true_eyes_m"])
        np.testing.assert_array_equal(light.solved_for_m, told[light.frame]["solved_for_m"])
