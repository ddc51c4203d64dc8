"""Who looks at refreshes: lines that wait for the truth, sampled quality, kept light; null where none was measured."""

from __future__ import annotations

import threading
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from runtime.clock import NS_PER_MS, NS_PER_S
from runtime.content.base import ContentSource
from runtime.evaluation.displayed import displayed
from runtime.frame import observer as observer_module
from runtime.frame.observer import RunObserver
from runtime.frame.presenter import Refresh
from runtime.frame.solver_host import Task
from runtime.model.predictor import Predictor
from runtime.optics.alignment import align, shown_layers
from runtime.optics.carried import carried_db
from runtime.plan.drawing import drawn_job, retina_pictures
from runtime.records import PanelFrame, RefreshAccount, SensorFrame, Solution, State
from runtime.support.background import wait_for_all
from tests.frame.conftest import SMALL
from tests.frame.fakes import EYES, FakeSolver, aside

PERIOD_NS = 20 * NS_PER_MS
FOV_DEG = 40.0
CONTRACT = {
    "frame", "capture_ns", "predicted_for_ns", "present_ns", "eyes_m", "eyes_label", "eye_sigma_mm", "state",
    "solution", "solved_for_m", "solution_age_ms", "true_eyes_m", "inference", "presented", "stage_ms", "skew_ms",
}  # fmt: skip


class Kept:
    """Output that keeps what it is given."""

    def __init__(self) -> None:
        self.lines: list[dict[str, Any]] = []
        self.lights: dict[int, dict[str, Any]] = {}

    def refresh(self, line: dict[str, Any]) -> None:
        self.lines.append(line)

    def light(self, frame: int, **what: Any) -> None:
        self.lights[frame] = what


class Drawing(FakeSolver):
    """A solver whose thread does tasks at once, or when the test says."""

    def __init__(self, content: Any, *, at_once: bool = True) -> None:
        super().__init__()
        self.content, self._at_once = content, at_once

    def do(self, task: Task) -> None:
        if self._at_once:
            task(self)  # type: ignore[arg-type]
        else:
            self.tasks.append(task)


@pytest.fixture
def solved(predictor: Predictor, content: Any) -> Solution:
    """A real solution for `EYES`."""
    layers = predictor.solve(drawn_job(predictor, content, EYES, time_ns=0)).layers.copy()
    return Solution(1, layers, EYES, 0)


def refresh(number: int, solution: Solution | None, *, eyes_m: Any = EYES, **changes: Any) -> Refresh:
    """One refresh at number · 20 ms, aligned to eyes."""
    light_ns = NS_PER_S + number * PERIOD_NS
    solved = solution.layers if solution is not None else None
    matrices = () if solution is None else align(SMALL, solved_for_m=EYES, eyes_m=eyes_m).solved_from_shown
    values: dict[str, Any] = {
        "frame": number, "capture_ns": light_ns - PERIOD_NS, "predicted_for_ns": light_ns,
        "present_ns": light_ns - 8 * NS_PER_MS, "eyes_m": eyes_m, "eyes_label": "predicted", "eye_sigma_mm": 2.0,
        "state": State.TRACKING, "solution": None if solution is None else solution.number,
        "solved_for_m": None if solution is None else EYES, "solution_age_ms": 10.0, "inference": "reused",
        "presented": True, "skew_ms": 0.0, "photon_ns": light_ns,
    }  # fmt: skip
    frame = PanelFrame(number, solved, 1, matrices, flatness=0.0 if solution is not None else 1.0)
    return Refresh(RefreshAccount(**(values | changes)), frame, solution)


def sample(time_ns: int, *, y_m: float | None = 0.0) -> SensorFrame:
    """One that knows the truth: a head that is aside by so much."""
    return SensorFrame(1, time_ns, true_eyes_m=None if y_m is None else aside(y_m))


def looking(
    content: Any, *, solver: Drawing | None = None, simulated: bool = True, **how: Any
) -> tuple[RunObserver, Kept]:
    kept = Kept()
    solver = solver or Drawing(content)
    return RunObserver(SMALL, solver, fov_deg=FOV_DEG, output=kept, simulated=simulated, **how), kept


# --- lines -------------------------------------------------------------------------------------------------------


def test_a_line_waits_for_the_recorded_truth_at_its_display_time(
    content: ContentSource,
) -> None:
    observer, kept = looking(content)
    observer.sampled(sample(NS_PER_S))
    observer.refreshed(refresh(1, None))
    assert kept.lines == []
    observer.sampled(sample(NS_PER_S + 40 * NS_PER_MS, y_m=0.004))
    assert kept.lines == []  # written between refreshes, not when a sample arrives
    observer.refreshed(refresh(3, None))
    assert [line["frame"] for line in kept.lines] == [1]
    assert kept.lines[0]["true_eyes_m"] == pytest.approx(aside(0.002))
    assert set(kept.lines[0]) == CONTRACT


def test_lines_come_in_order_each_once_whatever_they_wait_for(content: ContentSource) -> None:
    observer, kept = looking(content)
    random = np.random.default_rng(1)
    next_ns = NS_PER_S
    for number in range(60):
        observer.refreshed(refresh(number, None))
        if random.random() < 0.3:
            next_ns += int(random.integers(1, 100)) * NS_PER_MS
            observer.sampled(sample(next_ns))
    observer.finish()
    assert [line["frame"] for line in kept.lines] == list(range(60))


def test_what_the_recording_never_said_is_null_and_holds_nothing_up(content: ContentSource) -> None:
    observer, kept = looking(content)
    observer.sampled(sample(NS_PER_S, y_m=None))
    observer.refreshed(refresh(0, None))
    assert [line["true_eyes_m"] for line in kept.lines] == [None]
    observer.sampled(sample(NS_PER_S + PERIOD_NS))
    observer.refreshed(refresh(1, None))
    observer.refreshed(refresh(2, None))
    observer.finish()
    assert [line["true_eyes_m"] is None for line in kept.lines] == [True, False, True]


def test_lines_that_wait_are_bounded(content: ContentSource, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(observer_module, "WAITING_MAX", 16)
    observer, kept = looking(content)
    observer.sampled(sample(NS_PER_S))
    for number in range(1, 101):
        observer.refreshed(refresh(number, None))
    assert len(kept.lines) >= 100 - 16
    assert {line["true_eyes_m"] for line in kept.lines} == {None}


# --- sampled quality ---------------------------------------------------------------------------------------------


def test_nothing_measured_is_null(content: ContentSource, solved: Solution) -> None:
    observer, _ = looking(content)
    observer.refreshed(refresh(1, solved))
    observer.finish()
    assert observer.summary() == {
        "light_db": None, "psnr_db": None, "ssim": None, "carried_db": None, "psnr_db_true_eyes": None,
        "carried_db_true_eyes": None, "quality_frames": 0,
    }  # fmt: skip
    assert observer.moment is None


def test_quality_is_measured_at_the_eyes_used_and_at_the_true_ones(content: ContentSource, solved: Solution) -> None:
    observer, _ = looking(content, measure=True, evaluate_every=1)
    used, true = aside(0.015), aside(0.012)
    seen = refresh(1, solved, eyes_m=used)
    observer.sampled(sample(NS_PER_S + PERIOD_NS, y_m=0.012))
    observer.refreshed(seen)
    layers = shown_layers(seen.frame)
    how = {"fov_deg": FOV_DEG}

    def psnr(eyes_m: Any) -> tuple[float, float]:
        wanted = retina_pictures(content, eyes_m, SMALL, time_ns=0, **how)
        exact = displayed(layers, wanted, SMALL, eyes_m=eyes_m, **how).quality.psnr_db
        drawn = retina_pictures(content, EYES, SMALL, time_ns=0, **how)
        return exact, carried_db(layers, drawn, SMALL, solved_for_m=EYES, eyes_m=eyes_m, **how)

    summary = observer.summary()
    assert (summary["psnr_db"], summary["carried_db"]) == pytest.approx(psnr(used), abs=0.001)
    assert (summary["psnr_db_true_eyes"], summary["carried_db_true_eyes"]) == pytest.approx(psnr(true), abs=0.001)
    assert summary["quality_frames"] == 1


def test_every_so_many_refreshes_are_sampled_while_tracking_and_no_others(
    content: ContentSource, solved: Solution
) -> None:
    observer, _ = looking(content, measure=True, evaluate_every=5)
    for number in range(30):
        state = State.TRACKING if number < 15 else State.HOLDING
        observer.refreshed(refresh(number, solved, state=state))
    assert observer.summary()["quality_frames"] == 3
    observer.finish()
    assert observer.summary()["quality_frames"] == 3


@pytest.mark.parametrize("change", [{"presented": False}, {"eyes_m": None}, {"flatness": 0.5}])
def test_unseen_pictures_and_mixtures_with_the_flat_one_are_not_measured(
    content: ContentSource, solved: Solution, change: dict[str, Any]
) -> None:
    observer, _ = looking(content, measure=True, evaluate_every=1)
    seen = refresh(1, solved)
    if "flatness" in change:
        seen = replace(seen, frame=replace(seen.frame, flat=solved.layers, flat_version=2, **change))
    else:
        seen = replace(seen, account=replace(seen.account, **change))
    observer.refreshed(seen)
    observer.finish()
    assert observer.summary()["psnr_db"] is None


def test_a_short_run_measures_its_last_refresh(content: ContentSource, solved: Solution) -> None:
    observer, _ = looking(content, measure=True, evaluate_every=50)
    observer.refreshed(refresh(1, solved))
    observer.finish()
    assert observer.summary()["quality_frames"] == 1
    assert observer.moment is not None


def test_the_moment_shown_is_the_last_or_in_real_time_newest_measured(content: ContentSource, solved: Solution) -> None:
    for simulated, shown in ((True, 3), (False, 0)):
        observer, _ = looking(content, simulated=simulated, measure=True, evaluate_every=1)
        for number in range(4):
            observer.refreshed(refresh(number, solved, eyes_m=aside(0.001 * number)))
            wait_for_all(120.0 if number == 0 else 0.0)
            if not simulated and number == 0:
                observer._every = 100
        observer.finish()
        assert observer.moment is not None and observer.moment.lines[0].startswith(f"Refresh {shown};")
        np.testing.assert_array_equal(observer.moment.eye_views.eyes_m, aside(0.001 * shown))


def test_who_stops_a_run_waits_for_no_measurement(content: ContentSource, solved: Solution) -> None:
    solver = Drawing(content, at_once=False)  # busy
    observer, _ = looking(content, solver=solver, simulated=False, measure=True, evaluate_every=50)
    observer.refreshed(refresh(1, solved))
    observer.finish(patient=False)
    assert observer.moment is None and solver.tasks == []


def test_in_real_time_one_measurement_runs_at_a_time_and_delays_nothing(
    content: ContentSource, solved: Solution
) -> None:
    solver = Drawing(content, at_once=False)
    observer, _ = looking(content, solver=solver, simulated=False, measure=True, evaluate_every=1)
    for number in range(10):
        observer.refreshed(refresh(number, solved))
    assert len(solver.tasks) == 1  # the solver's thread draws when it comes to it
    assert solver.tasks[0](solver) is True
    assert wait_for_all(120.0) == 0
    observer.refreshed(refresh(10, solved))
    assert observer.summary()["quality_frames"] == 1


def test_comparing_is_not_the_presenter_s_nor_the_solver_s_work(
    content: ContentSource, solved: Solution, monkeypatch: pytest.MonkeyPatch
) -> None:
    threads = []
    real = observer_module.displayed
    monkeypatch.setattr(
        observer_module,
        "displayed",
        lambda *a, **k: (threads.append(threading.current_thread().name), real(*a, **k))[1],
    )
    observer, _ = looking(content, simulated=False, measure=True, evaluate_every=1)
    observer.refreshed(refresh(0, solved))
    assert wait_for_all(120.0) == 0
    assert threads == ["job quality"]


# --- kept light --------------------------------------------------------------------------------------------------


def test_every_nth_refresh_leaves_what_a_judge_needs(content: ContentSource, solved: Solution) -> None:
    observer, kept = looking(content, keep_light=4)
    shown = {}
    for number in range(12):
        seen = refresh(number, solved, eyes_m=aside(number / 500))
        shown[number] = shown_layers(seen.frame)
        observer.sampled(sample(seen.account.photon_ns, y_m=number / 400))
        observer.refreshed(seen)
    assert list(kept.lights) == [3, 7, 11]
    drawn = retina_pictures(content, EYES, SMALL, fov_deg=FOV_DEG, time_ns=0)
    for number, light in kept.lights.items():
        assert np.array_equal(light["layers"], shown[number])
        assert all(np.array_equal(a, b) for a, b in zip(light["drawn"], drawn, strict=True))
        info = light["info"]
        assert set(info) == {"solved_for_m", "eyes_m", "true_eyes_m", "fov"}
        assert np.array_equal(info["eyes_m"], aside(number / 500))
        assert np.array_equal(info["solved_for_m"], EYES)
        assert info["true_eyes_m"] == pytest.approx(aside(number / 400))
        assert info["fov"] == FOV_DEG
