"""What a moving viewer sees: the daemon's own loop on small panels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from runtime.evaluation.motion_recording import write_motion
from runtime.report.moving import moving_run, settings_for, simulated_run

SCALE = 0.15


def test_a_moving_head_sees_less_of_a_slow_solver_and_a_resting_one_as_much() -> None:
    quick, slow, rests = (
        moving_run(motion, solver_ms, seconds=2.5, scale=SCALE)
        for motion, solver_ms in (("lean", 20.0), ("lean", 200.0), ("still", 200.0))
    )
    assert quick.lights == slow.lights > 5
    assert slow.behind_mm > 2 * quick.behind_mm > 0
    assert quick.light_db > slow.light_db
    assert rests.light_db > slow.light_db
    assert slow.tracker_mm == quick.tracker_mm  # the tracker does not know of the solver


def test_a_runs_solver_takes_as_long_as_it_is_told_and_its_truth_is_the_recordings(tmp_path: Path) -> None:
    recording = tmp_path / "walk.mcap"
    write_motion(recording, "walk", seconds=2.0, seed=3)
    settings = settings_for(recording, solver_ms=200.0)
    solving = ("render", "prepare", "inference", "finish")
    assert sum(settings.loop.simulated_stage_ms[stage] for stage in solving) == pytest.approx(200.0)
    watched = simulated_run(settings, scale=SCALE, keep_light=10)
    assert watched.summary["solutions_per_s"] < 6
    told = {line["frame"]: line for line in watched.lines}
    assert len(watched.lights) > 5
    for light in watched.lights:
        np.testing.assert_array_equal(light.true_eyes_m, told[light.frame]["true_eyes_m"])
        np.testing.assert_array_equal(light.solved_for_m, told[light.frame]["solved_for_m"])
