"""What a moving viewer sees: the daemon's own loop on small panels."""

from __future__ import annotations

from runtime.report.moving import moving_run

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
