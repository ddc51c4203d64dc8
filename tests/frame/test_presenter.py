"""Tests that refreshes are aligned to the eyes at their display time, independent of the solver."""

from __future__ import annotations

import socket
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from runtime.clock import NS_PER_MS, NS_PER_S, MonotonicClock
from runtime.frame.aim import HORIZON_NS
from runtime.optics.alignment import align
from runtime.plan.savings import selected_eyes
from runtime.records import State
from tests.frame import fakes
from tests.frame.fakes import EYES, HZ, PERIOD_NS, STACK, Stage, aside, picture, solution


def moves(time_s: float) -> np.ndarray:
    """A head that sways by 10 cm."""
    return aside(0.1 * np.sin(2 * time_s), z_m=0.02 * np.cos(time_s))


@pytest.fixture
def stage() -> Stage:
    """Tracking, with a solution and a flat picture there."""
    made = Stage()
    made.solver.hand_over(flat=solution(1, None))
    made.solver.hand_over(solved=solution(2))
    made.refresh(5)
    return made


# --- waiting -----------------------------------------------------------------------------------------------------


def test_what_arrives_during_the_wait_is_taken_in_before_waking(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    taken_ns, left_ns = [], [9 * NS_PER_MS, 5 * NS_PER_MS]
    monkeypatch.setattr(stage.watching, "sampled", lambda sample: taken_ns.append(stage.clock.now_ns()))

    def is_readable(descriptors: list[int], *, until_ns: int) -> bool:
        if not left_ns:
            return False
        stage.clock.sleep_until_ns(until_ns - left_ns.pop(0))
        stage.samples.put(EYES, stage.clock.now_ns())
        return True

    monkeypatch.setattr(stage.clock, "is_readable", is_readable)
    account = stage.presenter.refresh()
    assert taken_ns[1] - taken_ns[0] == 4 * NS_PER_MS
    assert account.capture_ns == taken_ns[1] < account.present_ns - 5 * NS_PER_MS


def test_an_ended_process_does_not_keep_the_presenter_waiting(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its channel stays readable although nothing arrives."""
    monkeypatch.setattr(stage.clock, "is_readable", lambda descriptors, *, until_ns: True)
    before_ns = stage.presenter.refresh().present_ns
    assert stage.presenter.refresh().present_ns - before_ns == pytest.approx(PERIOD_NS, rel=0.01)


def test_the_real_clock_waits_for_the_first_descriptor_to_be_readable() -> None:
    clock, (ours, theirs) = MonotonicClock(), socket.socketpair()
    with ours, theirs:
        until_ns = clock.now_ns() + 30 * NS_PER_MS
        assert not clock.is_readable([ours.fileno()], until_ns=until_ns)
        assert clock.now_ns() > until_ns - 2 * NS_PER_MS
        assert not clock.is_readable([], until_ns=clock.now_ns() + NS_PER_S)
        theirs.send(b"1")
        assert clock.is_readable([ours.fileno()], until_ns=clock.now_ns() + 60 * NS_PER_S)
        assert not clock.is_readable([ours.fileno()], until_ns=clock.now_ns())


# --- alignment ---------------------------------------------------------------------------------------------------


def test_every_refresh_is_aligned_to_the_eyes_of_its_own_light(stage: Stage) -> None:
    stage.eyes = moves
    for _ in range(40):
        (done,) = stage.refresh()
        account = done.account
        expected = stage.viewer.ahead(account.predicted_for_ns)
        assert np.array_equal(account.eyes_m, expected.eyes_m)
        found = align(STACK, solved_for_m=EYES, eyes_m=account.eyes_m)
        assert len(done.frame.solved_from_shown) == STACK.count
        for given, wanted in zip(done.frame.solved_from_shown, found.solved_from_shown, strict=True):
            assert np.array_equal(given, wanted)
    assert not np.array_equal(done.frame.solved_from_shown[0], np.eye(3))


def test_a_late_panel_is_aligned_to_eyes_of_its_own_time() -> None:
    speed_m_s, delays_ms = 0.2, (0.0, 4.0, 12.0)
    stage = Stage(output={"panels": [{"delay_ms": delay_ms} for delay_ms in delays_ms]})
    stage.solver.hand_over(solved=solution(2))
    stage.eyes = lambda time_s: aside(speed_m_s * time_s)
    stage.refresh(40)
    (done,) = stage.refresh()
    for n, (matrix, _) in enumerate(done.frame.on_monitors):
        eyes_m = stage.viewer.ahead(done.account.predicted_for_ns + round(delays_ms[n] * NS_PER_MS)).eyes_m
        assert eyes_m is not None
        assert np.array_equal(matrix, align(STACK, solved_for_m=EYES, eyes_m=eyes_m).solved_from_shown[n])
    # Closed form: seen from x = D, a panel at x = a follows the head's way v·t by v·t·a/D, and the picture moves back.
    x_m, distance_m = STACK.x_m[-1], EYES[:, 0].mean()
    moved_px = speed_m_s * 0.012 * x_m / distance_m / STACK.width_m * STACK.width_px
    ahead_px = done.frame.solved_from_shown[-1][0, 2] - done.frame.on_monitors[-1][0][0, 2]
    assert ahead_px == pytest.approx(moved_px, rel=0.05)
    stage.eyes = lambda _: None
    stage.refresh(HZ)
    (done,) = stage.refresh()
    assert len(done.frame.on_monitors) == STACK.count  # the last alignment stays
    assert Stage().refresh()[0].frame.on_monitors == ()


def test_a_refresh_is_aligned_from_the_eyes_of_the_solution_it_shows(stage: Stage) -> None:
    stage.eyes = moves
    stage.refresh(30)
    solved_for = aside(0.05)
    stage.solver.hand_over(solved=solution(9, solved_for))
    (done,) = stage.refresh()
    wanted = align(STACK, solved_for_m=solved_for, eyes_m=done.account.eyes_m).solved_from_shown
    assert all(np.array_equal(a, b) for a, b in zip(done.frame.solved_from_shown, wanted, strict=True))
    assert np.array_equal(done.account.solved_for_m, solved_for)
    assert (done.frame.solved == picture(9)).all()


def test_alignment_can_be_switched_off_while_it_runs(stage: Stage) -> None:
    stage.eyes = moves
    stage.change(align=False)
    (done,) = stage.refresh()
    assert done.frame.solved_from_shown == ()
    stage.change(align=True)
    assert len(stage.refresh()[0].frame.solved_from_shown) == STACK.count


def test_eyes_too_far_off_are_aligned_as_far_as_possible(stage: Stage) -> None:
    stage.eyes = lambda _: aside(3.0)
    stage.refresh(30)
    machine = stage.presenter.machine
    assert machine.state is State.TRACKING
    assert "the alignment has reached its limit" in machine.reason
    assert "too far to align" in machine.reason
    assert np.isfinite(stage.panels.frame.solved_from_shown[0]).all()
    stage.solver.hand_over(solved=solution(7, aside(3.0)))
    stage.refresh()
    assert "limit" not in machine.reason


def test_eyes_behind_the_panels_are_none_and_the_picture_goes_flat(stage: Stage) -> None:
    stage.eyes = lambda _: aside(x_m=-0.7)
    stage.refresh(60)
    assert stage.presenter.last.account.eyes_label == "none"
    assert stage.presenter.last.frame.flatness == 1.0
    assert "not in front of the panels" in stage.presenter.machine.reason  # reported, instead of a silent flat picture


def test_an_eye_that_the_solution_was_not_made_for_moves_nothing(stage: Stage) -> None:
    one = EYES[[0, 0]]
    stage.solver.hand_over(solved=solution(5, one, seeing=(True, False)))
    (done,) = stage.refresh()
    used = done.account.eyes_m[[0, 0]]
    wanted = align(STACK, solved_for_m=one, eyes_m=used).solved_from_shown
    assert all(np.array_equal(a, b) for a, b in zip(done.frame.solved_from_shown, wanted, strict=True))


def test_at_rest_codes_ignore_noise_and_with_movement_they_change() -> None:
    """A 60 Hz head with 3 mm of noise does not shimmer."""
    from runtime.optics.presentation import shown_layers

    random = np.random.default_rng(3)
    textured = random.integers(0, 256, (STACK.count, STACK.height_px, STACK.width_px, 4)).astype(np.uint8)

    def changes(aside_m: Any) -> list[bool]:
        stage = Stage(plan={"enabled": True})
        stage.eyes = lambda s: aside(aside_m(s)) + random.normal(0.0, 0.003, (2, 3))
        stage.solver.hand_over(flat=solution(1, None))
        solved = solution(2, aside(0.01))
        solved.layers[:] = textured
        stage.solver.hand_over(solved=solved)
        stage.refresh(2 * HZ)
        shown = [shown_layers(done.frame) for done in stage.refresh(2 * HZ)]
        return [not np.array_equal(a, b) for a, b in pairwise(shown)]

    assert not any(changes(lambda _: 0.0))
    assert all(changes(lambda s: 0.1 * np.sin(3 * s)))


# --- the flat picture --------------------------------------------------------------------------------------------


def test_before_the_first_solution_the_flat_picture_is_shown_without_fading() -> None:
    stage = Stage()
    stage.solver.hand_over(flat=solution(1, None))
    (done,) = stage.refresh()
    assert (done.frame.flatness, done.frame.solved_version, done.frame.flat_version) == (1.0, 0, 1)
    assert (done.account.inference, done.account.solution, done.account.presented) == ("skipped", None, True)
    stage.refresh(10)
    stage.solver.hand_over(solved=solution(2))
    (done,) = stage.refresh()
    assert (done.frame.flatness, done.account.inference, done.account.effort) == (0.0, "ran", "1/1+0")
    asked = Stage()
    asked.presenter.flat_asked = True
    asked.solver.hand_over(flat=solution(1, None), solved=solution(2))
    assert asked.refresh(5)[-1].frame.flatness == 1.0
    asked.presenter.flat_asked = False
    assert asked.refresh()[0].frame.flatness == 0.0, "the first picture that is seen"


def test_a_lost_viewer_is_held_then_fades_to_flat_and_back(stage: Stage) -> None:
    stage.eyes = lambda s: EYES if s < 1.0 or s > 3.0 else None
    states, flatness = [], []
    for done in stage.refresh(5 * HZ):
        states.append(done.account.state)
        flatness.append(done.frame.flatness)
    seen = [state for state, before in zip(states, [None, *states], strict=False) if state is not before]
    assert seen == [State.TRACKING, State.HOLDING, State.FLAT, State.TRACKING]
    assert all(f == 0.0 for f, state in zip(flatness, states, strict=True) if state is State.HOLDING)
    steps = np.abs(np.diff(flatness))
    assert steps.max() == pytest.approx(PERIOD_NS / NS_PER_S / 0.3, rel=0.01)  # BLEND_S
    assert max(flatness) == 1.0
    assert flatness[-1] == 0.0
    assert all(done.account.presented for done in stage.watching.refreshes)


def test_while_eyes_are_lost_the_last_alignment_stays(stage: Stage) -> None:
    stage.eyes = lambda s: moves(s) if s < 0.5 else None
    stage.refresh(HZ)
    held = [done for done in stage.watching.refreshes if done.account.eyes_m is not None][-1]
    stage.refresh(HZ)
    assert stage.presenter.last.account.eyes_m is None
    for one, other in zip(held.frame.solved_from_shown, stage.panels.frame.solved_from_shown, strict=True):
        assert np.array_equal(one, other)


def test_flat_can_be_asked_for_and_given_up(stage: Stage) -> None:
    stage.presenter.flat_asked = True
    stage.refresh(30)
    assert stage.panels.frame.flatness == 1.0
    assert (stage.presenter.machine.state, stage.presenter.machine.reason) == (State.FLAT, "requested")
    assert all(request.flat_wanted for request in stage.solver.requests[-29:])
    assert all(request.eyes_m is not None for request in stage.solver.requests[-29:])  # it is ready to come back
    stage.presenter.flat_asked = False
    stage.refresh(30)
    assert stage.panels.frame.flatness == 0.0
    assert stage.presenter.machine.state is State.TRACKING


def test_the_flat_picture_is_wanted_as_soon_as_eyes_are_held(stage: Stage) -> None:
    stage.eyes = lambda s: EYES if s < 0.5 else None
    stage.refresh(HZ)
    labels = [done.account.eyes_label for done in stage.watching.refreshes]
    wanted = [request.flat_wanted for request in stage.solver.requests]
    assert "held" in labels
    assert wanted.index(True, 6) == labels.index("held")


# --- pause -------------------------------------------------------------------------------------------------------


def test_paused_makes_nothing_new_but_stays_aligned(stage: Stage) -> None:
    stage.presenter.paused = True
    stage.eyes = moves
    matrices = [done.frame.solved_from_shown[0] for done in stage.refresh(HZ)]
    assert all(request.paused for request in stage.solver.requests[-HZ:])
    assert "paused" in stage.presenter.machine.reason
    assert len({matrix.tobytes() for matrix in matrices}) > HZ / 2


def test_a_blend_takes_its_time_after_a_pause_too(stage: Stage) -> None:
    stage.presenter.paused = True
    stage.refresh(HZ)
    stage.presenter.paused, stage.presenter.flat_asked = False, True
    assert stage.refresh()[0].frame.flatness < 0.1
    assert stage.refresh(HZ)[-1].frame.flatness == 1.0


def test_a_paused_picture_can_be_made_flat(stage: Stage) -> None:
    stage.presenter.paused = True
    stage.refresh(HZ)
    stage.presenter.flat_asked = True
    assert stage.refresh()[0].frame.flatness < 0.1
    assert stage.refresh(HZ)[-1].frame.flatness == 1.0


# --- unchanged ---------------------------------------------------------------------------------------------------


def test_a_picture_is_vouched_to_be_unchanged_only_where_nothing_differs() -> None:
    stage = Stage(plan={"enabled": True})
    stage.solver.hand_over(flat=solution(1, None))
    stage.solver.hand_over(solved=solution(2))
    stage.refresh(2 * HZ)  # the head comes to rest
    assert all(unchanged for _, unchanged in stage.panels.shown[-20:])
    stage.solver.hand_over(solved=solution(3))
    stage.refresh()
    assert not stage.panels.unchanged  # another solution
    stage.refresh()
    assert stage.panels.unchanged
    stage.solver.hand_over(flat=solution(4, None))
    stage.refresh()
    assert stage.panels.unchanged  # another flat picture, invisible
    stage.presenter.flat_asked = True
    stage.refresh()
    assert not stage.panels.unchanged  # the mixture differs
    stage.refresh(HZ)
    assert stage.panels.unchanged  # all flat
    stage.solver.hand_over(flat=solution(5, None))
    stage.refresh()
    assert not stage.panels.unchanged  # and now it is seen


# --- faults ------------------------------------------------------------------------------------------------------


def test_a_lost_panel_drops_refreshes_and_comes_back_with_the_newest(stage: Stage) -> None:
    stage.change(align=False)
    stage.refresh(2)
    assert stage.panels.unchanged
    stage.panels.lost = "DUMMY1 was disconnected"
    stage.solver.hand_over(solved=solution(8))
    lost = stage.refresh(3)
    assert [done.account.presented for done in lost] == [False] * 3
    assert "ran" not in [done.account.inference for done in lost]
    assert stage.presenter.machine.name == "degraded: panel"
    assert "DUMMY1" in stage.presenter.machine.reason
    assert stage.presenter.stats.dropped == 3
    assert stage.presenter.stats.faults == {"panel": 1}
    stage.panels.lost = ""
    (back,) = stage.refresh()
    assert back.account.presented and back.account.inference == "ran"  # with the refresh that first shows it
    assert not stage.panels.unchanged  # not marked as unchanged
    assert stage.panels.frame.solved_version == 8
    assert stage.presenter.machine.state is State.TRACKING


@pytest.mark.parametrize("part", ["content", "model"])
def test_a_solver_fault_is_reported_once_and_the_last_solution_stays_aligned(stage: Stage, part: str) -> None:
    stage.solver.hand_over(**{part: "out of memory"})
    stage.eyes = moves
    done = stage.refresh(30)
    assert stage.presenter.machine.name == f"degraded: {part}"
    assert "out of memory" in stage.presenter.machine.reason
    assert stage.presenter.stats.faults == {part: 1}
    assert all(entry.account.presented for entry in done)
    assert len({entry.frame.solved_from_shown[0].tobytes() for entry in done}) > 20
    stage.solver.hand_over()
    stage.refresh()
    assert stage.presenter.machine.state is State.TRACKING


def test_a_lost_sensor_is_named(stage: Stage) -> None:
    stage.samples.why = "unplugged"
    stage.refresh()
    assert stage.presenter.machine.name == "degraded: sensor"
    assert stage.presenter.status.sensor_hz is None
    stage.samples.why = "unplugged for 2 s"
    stage.refresh()
    stage.samples.why = ""
    stage.refresh()
    assert stage.presenter.machine.state is State.TRACKING
    assert stage.presenter.stats.faults == {"sensor": 1} and stage.presenter.status.sensor_hz == 60.0


def test_no_refresh_waits_for_the_solver() -> None:
    """No task is handed over for ten seconds: as many refreshes as there are slots, each with its own eyes."""
    stage = Stage()
    stage.solver.hand_over(flat=solution(1, None))
    stage.solver.hand_over(solved=solution(2))
    stage.eyes = moves
    done = stage.refresh(10 * HZ)
    presents = np.array([entry.account.present_ns for entry in done])
    assert np.abs(np.diff(presents) - PERIOD_NS).max() <= 2
    assert stage.pacer.missed == 0
    assert {entry.account.solution for entry in done[5:]} == {2}
    ages = np.diff([entry.account.solution_age_ms for entry in done[5:]])
    assert ages == pytest.approx(PERIOD_NS / NS_PER_MS, abs=0.01)  # and it says how old the solution is


# --- requests to the solver ------------------------------------------------------------------------------------


def test_eyes_are_requested_for_the_middle_of_the_solution_s_showing(
    stage: Stage,
) -> None:
    stage.eyes = moves
    for cost_ms in (1, 20, 60):
        stage.solver.solve_cost_ns = cost_ms * NS_PER_MS
        (done,) = stage.refresh()
        request = stage.solver.requests[-1]
        first = max(1, -(-stage.solver.solve_cost_ns // PERIOD_NS))
        last = max(first, -(-2 * stage.solver.solve_cost_ns // PERIOD_NS) - 1)
        assert request.time_ns == pytest.approx(
            done.account.predicted_for_ns + (first + last) * PERIOD_NS / 2, abs=PERIOD_NS / 100
        )
        reached_ns = min(request.time_ns, done.account.predicted_for_ns + HORIZON_NS)
        ahead_m = stage.viewer.ahead(reached_ns).eyes_m
        # Not all of the way where the tracker does not know it.
        way, gone = ((eyes_m - done.account.eyes_m).mean(axis=0) for eyes_m in (ahead_m, request.eyes_m))
        assert 0.0 <= float(gone @ way) <= float(way @ way) * 1.0001
        np.testing.assert_allclose(np.cross(gone, way), 0.0, atol=1e-12)
        assert request.sigma_m * 1000 == pytest.approx(done.account.eye_sigma_mm)


# --- accounts ----------------------------------------------------------------------------------------------------


def test_a_solution_ran_at_its_first_refresh_and_is_reused_later(stage: Stage) -> None:
    stage.solver.hand_over(solved=solution(3, stage_ms={"render": 8.0, "inference": 3.0, "step": 5.0}))
    told = [done.account for done in stage.refresh(3)]
    assert [account.inference for account in told] == ["ran", "reused", "reused"]
    assert {name: told[0].stage_ms[name] for name in ("render", "prepare", "inference", "finish")} == {
        "render": 8.0, "prepare": 0.0, "inference": 3.0, "finish": 5.0,
    }  # fmt: skip
    assert set(told[1].stage_ms) == {"wait", "sensor", "track", "present"}


def test_time_that_a_drawn_frame_is_held_back_counts_as_waiting(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    present = stage.panels.present
    monkeypatch.setattr(stage.panels, "present", lambda *one, **how: replace(present(*one, **how), held_ns=400_000))
    stage_ms = stage.presenter.refresh().stage_ms
    assert (stage_ms["present"], stage_ms["wait"]) == pytest.approx((0.6, 0.4))


def test_frames_are_numbered_and_counted_and_a_run_ends_after_so_many(stage: Stage) -> None:
    begun = stage.presenter.stats.frames
    assert stage.presenter.run(frames=begun + 5) == f"reached the limit of {begun + 5} frames"
    assert [done.account.frame for done in stage.watching.refreshes] == list(range(begun + 5))
    assert stage.presenter.machine.state is State.STOPPING


def test_a_recording_that_ends_ends_the_run(stage: Stage) -> None:
    stage.samples.ends_ns = stage.clock.now_ns() + NS_PER_S
    assert stage.presenter.run() == "the recording has ended"


def test_every_sample_reaches_the_viewer_and_the_observer_in_order() -> None:
    stage = Stage(sensor_hz=240.0)
    stage.refresh(HZ)
    numbers = [sample.sequence for sample in stage.watching.samples]
    assert numbers == list(range(1, len(numbers) + 1))
    assert len(numbers) >= 230
    assert stage.viewer.rate_hz == pytest.approx(240.0, rel=0.01)


def test_other_settings_reach_the_viewer_with_the_next_refresh(stage: Stage) -> None:
    settings = stage.presenter.settings
    tracker = settings.tracker.model_copy(update={"hold_s": 0.0})
    stage.presenter.adopt(settings.model_copy(update={"tracker": tracker}))
    stage.eyes = lambda _: None
    stage.refresh(30)
    assert stage.presenter.machine.state is State.FLAT
    assert stage.panels.frame.flatness == 1.0


def test_panels_that_take_longer_than_a_period_are_told_by_the_presenter() -> None:
    stage = Stage()
    stage.solver.hand_over(solved=solution(1))
    present = stage.panels.present

    def slow(frame: Any, *, unchanged: bool = False, due_ns: int | None = None) -> Any:
        stage.clock.advance_ns(round(1.6 * PERIOD_NS))
        return present(frame, unchanged=unchanged, due_ns=due_ns)

    stage.refresh(150)
    assert "late" not in stage.presenter.machine.reason
    stage.panels.present = slow
    stage.refresh(150)
    assert stage.presenter.machine.state is State.TRACKING
    assert "late: " in stage.presenter.machine.reason
    now = stage.presenter.stats.rates_now()["fps_now"]
    told_now = int(stage.presenter.machine.reason.split("late: ")[1].split()[0])
    assert abs(told_now - now) <= 2


def test_a_model_whose_rasters_are_not_timed_yet_stops_no_refresh(stage: Stage) -> None:
    """A model is replaced on the solver's thread; the presenter may see it before its costs are known."""
    stage.solver.offered = (1, 2, 3, 4)
    stage.eyes = moves
    stage.refresh(30)
    assert {request.effort.reduction for request in stage.solver.requests[-30:]} == {1}
    stage.solver.reductions, stage.solver.solve_cost_ns = (1, 2, 3, 4), 300 * NS_PER_MS
    stage.refresh(30)
    assert stage.solver.requests[-1].effort.reduction > 1


def test_a_solver_that_has_not_started_yet_stops_no_refresh(stage: Stage) -> None:
    stage.solver.reductions = ()
    stage.eyes = moves
    before = stage.presenter.stats.frames
    stage.refresh(30)
    assert stage.presenter.stats.frames == before + 30


@pytest.mark.parametrize("rate_hz", [1, 7, 8, 9])
def test_a_display_of_a_few_hertz_stops_no_refresh(monkeypatch: pytest.MonkeyPatch, rate_hz: int) -> None:
    """At 8 Hz, a period is as long as eyes are predicted ahead."""
    monkeypatch.setattr(fakes, "PERIOD_NS", NS_PER_S // rate_hz)
    stage = Stage()
    stage.eyes = moves
    stage.refresh(20)
    assert stage.solver.requests[-1].eyes_m is not None


def test_a_calm_head_gets_longer_solutions_within_a_second() -> None:
    """The longer a head has been calm, the less it matters that panels cannot answer while a solution is computed."""
    stage = Stage()
    stage.solver.offered = stage.solver.reductions = (1, 2, 3, 4)
    stage.solver.solve_cost_ns = 600 * NS_PER_MS
    stage.eyes = lambda time_s: aside(0.002 * np.sin(2 * time_s))
    stage.refresh(HZ)
    asked = [request.effort.reduction for request in stage.solver.requests]
    assert asked[HZ // 3] > 2
    assert asked[-1] == 2


def test_a_head_that_has_rested_counts_as_one_that_never_moved() -> None:
    """The speed before the rest says nothing about a head that stirs after it."""

    def asked(before: Callable[[float], Any]) -> list[int]:
        stage = Stage(plan={"enabled": True})
        stage.solver.offered = stage.solver.reductions = (1, 2, 3, 4)
        stage.solver.solve_cost_ns = 150 * NS_PER_MS
        stage.eyes = lambda time_s: before(time_s) if time_s < 2.0 else aside(0.01 * max(time_s - 6.0, 0.0))
        stage.refresh(6 * HZ)
        assert stage.solver.requests[-1].eyes_label == "rested"
        stage.refresh(HZ)
        requests = stage.solver.requests[-HZ:]
        assert requests[-1].eyes_label == "predicted"
        return [request.effort.reduction for request in requests]

    assert asked(lambda time_s: aside(0.5 * np.sin(4 * time_s))) == asked(lambda time_s: EYES)


def test_a_viewer_of_whom_one_eye_sees_gets_no_coarser_solutions() -> None:
    """The solution is for the left eye alone, whose place is not that of the midpoint."""
    beside_m = np.array([[0.123, 0.43, 0.0], [0.078, 0.47, 0.0]])

    def asked(seeing: tuple[bool, bool]) -> list[int]:
        stage = Stage()
        stage.solver.offered = stage.solver.reductions = (1, 2, 3, 4)
        stage.solver.solve_cost_ns = 150 * NS_PER_MS
        stage.eyes = lambda _: beside_m
        for number in range(HZ):
            stage.refresh()
            request = stage.solver.requests[-1]
            if request.eyes_m is not None:
                eyes_m = selected_eyes(request.eyes_m, seeing)
                made = solution(number + 2, eyes_m, time_ns=request.time_ns, effort=request.effort, seeing=seeing)
                stage.solver.hand_over(solved=made)
        return [request.effort.reduction for request in stage.solver.requests[HZ // 2 :]]

    assert asked((True, False)) == asked((True, True))


def test_a_moving_head_about_to_be_given_up_gets_no_long_solution(stage: Stage) -> None:
    """Otherwise the solver is busy when the head comes back."""
    stage.solver.offered = stage.solver.reductions = (1, 2, 3, 4)
    stage.solver.solve_cost_ns = 400 * NS_PER_MS
    stage.eyes = moves
    stage.refresh(90)
    stage.eyes = lambda _: None
    stage.refresh(60)
    assert stage.presenter.machine.state is State.FLAT
    after_loss = [request for request in stage.solver.requests[-60:] if request.eyes_m is not None]
    assert len(after_loss) > 10
    assert all(request.effort.reduction > 1 for request in after_loss)
