"""Tests observers of refreshes: lines that wait for the truth, sampled quality, kept layers."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from dataclasses import replace
from itertools import count
from threading import Timer
from typing import Any

import numpy as np
import pytest

from runtime.clock import NS_PER_MS, NS_PER_S
from runtime.config import Settings
from runtime.content.base import ContentInfo, ContentSource, View
from runtime.evaluation.displayed import displayed
from runtime.evaluation.refresh_quality import RefreshTargets
from runtime.frame import sampling
from runtime.frame.measuring import Comparison, MeasuringProcess
from runtime.frame.messages import Draw, Facts, Order
from runtime.frame.observer import RunObserver
from runtime.frame.refresh import Refresh
from runtime.frame.refresh_lines import RefreshLines
from runtime.frame.targets import TargetDrawer, drawn
from runtime.frame.truth import TrueEyes
from runtime.model.predictor import Predictor
from runtime.optics.alignment import align
from runtime.optics.carried import carried_db, expected_psnrs_db, intensities
from runtime.optics.focus import retina_db
from runtime.optics.presentation import shown_layers
from runtime.plan.drawing import drawn_job, retina_pictures
from runtime.plan.focusing import focus_targets, focused_job
from runtime.records import Effort, PanelFrame, PersonAccount, RefreshAccount, SensorFrame, Solution, State
from runtime.support.background import BACKGROUND_NICENESS, wait_for_all
from tests.frame.conftest import SMALL
from tests.frame.fakes import EYES, FakeSolver, aside, facts
from tests.waiting import eventually

PERIOD_NS = 20 * NS_PER_MS
FOV_DEG = 40.0
CONTRACT = {
    "frame", "capture_ns", "predicted_for_ns", "present_ns", "eyes_m", "eyes_label", "eye_sigma_mm", "state",
    "solution", "effort", "solved_for_m", "solution_age_ms", "true_eyes_m", "inference", "presented", "stage_ms",
    "skew_ms", "people",
}  # fmt: skip


made: list[MeasuringProcess] = []


@pytest.fixture(autouse=True)
def closed() -> Iterator[None]:
    """Ends the measuring processes."""
    yield
    while made:
        made.pop().close()


class Kept:
    """Output that keeps all it receives."""

    def __init__(self) -> None:
        self.lines: list[dict[str, Any]] = []
        self.lights: dict[int, dict[str, Any]] = {}

    def refresh(self, line: dict[str, Any]) -> None:
        self.lines.append(line)

    def light(self, frame: int, *, layers: Any) -> None:
        self.lights[frame] = {"layers": layers}

    def light_targets(self, frame: int, **what: Any) -> None:
        self.lights[frame] |= what


class Drawing(FakeSolver):
    """A solver that draws immediately, or on request."""

    def __init__(self, content: Any, *, at_once: bool = True) -> None:
        super().__init__()
        self.content, self.at_once, self.scene, self.fov_deg = content, at_once, 1, FOV_DEG
        self.focus = "off"

    @property
    def facts(self) -> Facts:
        settings = Settings.model_validate({"content": {"fov_deg": self.fov_deg, "focus": self.focus}})
        return facts(settings, scene=self.scene)

    def _dispatch(self, order: Order) -> None:
        super()._dispatch(order)
        if self.at_once:
            self.draw()

    def draw(self) -> None:
        """Carry out the oldest order."""
        order = self.orders.pop(0)
        assert isinstance(order, Draw)
        self._answered(drawn(order, self.content, scene=self.scene, stack=SMALL))


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
    """Sample with ground truth: a head displaced sideways."""
    return SensorFrame(1, time_ns, true_eyes_m=None if y_m is None else aside(y_m))


def looking(
    content: Any, *, solver: Drawing | None = None, simulated: bool = True, **how: Any
) -> tuple[RunObserver, Kept]:
    kept = Kept()
    drawer = TargetDrawer(solver or Drawing(content))
    made.append(MeasuringProcess(SMALL))
    return RunObserver(SMALL, drawer, made[-1], output=kept, simulated=simulated, **how), kept


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


def test_of_2048_lines_that_wait_the_oldest_is_written(content: ContentSource) -> None:
    observer, kept = looking(content)
    observer.sampled(sample(NS_PER_S))
    for number in range(1, 2048):
        observer.refreshed(refresh(number, None))
    assert kept.lines == []
    observer.refreshed(refresh(2048, None))
    observer.refreshed(refresh(2049, None))
    assert [(line["frame"], line["true_eyes_m"]) for line in kept.lines] == [(1, None), (2, None)]


def test_view_errors_are_each_person_s_or_the_one_s_served_last(solved: Solution) -> None:
    lines = RefreshLines(TrueEyes(), None)
    known = PersonAccount(4, EYES, EYES, aside(0.02)), PersonAccount(2, EYES, None, EYES), PersonAccount(3, EYES, EYES)
    tellings: list[dict[str, Any]] = [{"true_eyes_m": aside(0.01)}, {"people": known}, {"true_eyes_m": aside(0.04)}]
    for told in tellings:
        lines.add(refresh(1, solved, **told).account)
        lines.advance()
    by_person = {number: errors.of("p50") for number, errors in lines.people_mm.items()}
    assert by_person == {1: {"p50": 10.0}, 4: {"p50": 30.0}}
    assert lines.view_error_mm.of("p50", "max") == {"p50": 20.0, "max": 40.0}


# --- sampled quality ---------------------------------------------------------------------------------------------


def test_nothing_measured_is_null(content: ContentSource, solved: Solution) -> None:
    observer, _ = looking(content)
    observer.refreshed(refresh(1, solved))
    observer.finish()
    assert observer.summary() == {
        "live_db": None, "view_error_mm": None, "light_db": None, "psnr_db": None, "ssim": None, "carried_db": None,
        "psnr_db_true_eyes": None, "carried_db_true_eyes": None, "retina_db": None,
        "quality_frames": 0, "live_frames": 0, "people": [],
    }  # fmt: skip
    assert observer.moment is None


def test_quality_is_measured_at_the_eyes_used_and_at_the_true_ones(content: ContentSource, solved: Solution) -> None:
    observer, _ = looking(content, evaluate_every=1)
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


@pytest.mark.parametrize("focus", [False, True])
def test_the_last_solution_s_retina_is_measured_if_focus_is_on(
    predictor: Predictor, content: ContentSource, solved: Solution, focus: bool
) -> None:
    solver = Drawing(content)
    solver.focus = "on"
    if focus:
        job = focused_job(content, drawn_job(predictor, content, EYES, time_ns=0), time_ns=0, focus="on")
        assert job is not None
        solved = replace(solved, layers=predictor.solve(job).layers.copy(), effort=Effort(1, 16, focus=True))
    observer, _ = looking(content, solver=solver, evaluate_every=1)
    observer.refreshed(refresh(1, solved))
    observer.finish()
    targets = focus_targets(content, EYES, SMALL, time_ns=0)
    assert targets is not None and len(targets.pictures) == 6
    front_m, middle_m, rear_m = targets.planes_m
    assert front_m > middle_m > rear_m
    seen = targets.seen(solved.layers, SMALL)
    expected_db = retina_db(zip(seen, map(intensities, targets.pictures), strict=True))
    assert observer.summary()["retina_db"] == pytest.approx(expected_db, abs=0.001)
    assert expected_db > 20
    assert observer.moment is not None and (observer.moment.focused is not None) == focus


def test_content_without_depth_has_no_retina_pictures() -> None:
    class Flat(ContentSource):
        def __init__(self) -> None:
            self.info = ContentInfo("flat")

        def render(self, view: View, *, time_ns: int) -> Any:
            return np.full((view.height_px, view.width_px, 4), 90, np.uint8)

    assert focus_targets(Flat(), EYES, SMALL, time_ns=0) is None


def test_every_so_many_refreshes_are_sampled_while_tracking_and_no_others(
    content: ContentSource, solved: Solution
) -> None:
    observer, _ = looking(content, evaluate_every=5)
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
    observer, _ = looking(content, evaluate_every=1)
    seen = refresh(1, solved)
    if "flatness" in change:
        seen = replace(seen, frame=replace(seen.frame, flat=solved.layers, flat_version=2, **change))
    else:
        seen = replace(seen, account=replace(seen.account, **change))
    observer.refreshed(seen)
    observer.finish()
    assert observer.summary()["psnr_db"] is None


def test_a_short_run_measures_its_last_refresh(content: ContentSource, solved: Solution) -> None:
    observer, _ = looking(content, evaluate_every=50)
    observer.refreshed(refresh(1, solved))
    observer.finish()
    assert observer.summary()["quality_frames"] == 1
    assert observer.moment is not None


def test_the_moment_shown_is_the_last_or_in_real_time_newest_measured(content: ContentSource, solved: Solution) -> None:
    for simulated, shown in ((True, 3), (False, 0)):
        observer, _ = looking(content, simulated=simulated, evaluate_every=1)
        for number in range(4):
            observer.refreshed(refresh(number, solved, eyes_m=aside(0.001 * number)))
            wait_for_all(120.0 if number == 0 else 0.0)
            if not simulated and number == 0:
                observer._sampler._every = 100
        observer.finish()
        assert observer.moment is not None and observer.moment.lines[0].startswith(f"Refresh {shown}:")
        np.testing.assert_array_equal(observer.moment.eye_views.eyes_m, aside(0.001 * shown))


def test_who_stops_a_run_waits_for_no_measurement(content: ContentSource, solved: Solution) -> None:
    solver = Drawing(content, at_once=False)  # busy
    observer, _ = looking(content, solver=solver, simulated=False, evaluate_every=50)
    observer.refreshed(refresh(1, solved))
    observer.finish(lambda: True)
    assert observer.moment is None and solver.orders == []


def test_who_stops_a_run_begins_no_measurement_and_keeps_the_last(content: ContentSource, solved: Solution) -> None:
    solver = Drawing(content, at_once=False)
    observer, _ = looking(content, solver=solver, simulated=False, evaluate_every=1)
    observer.refreshed(refresh(1, solved))
    observer.refreshed(refresh(2, solved))  # queued
    solver.draw()
    assert wait_for_all(120.0) == 0
    observer.finish(lambda: True)
    assert solver.orders == []
    assert observer.summary()["quality_frames"] == 1


def test_in_real_time_one_measurement_runs_at_a_time_and_delays_nothing(
    content: ContentSource, solved: Solution
) -> None:
    solver = Drawing(content, at_once=False)
    observer, _ = looking(content, solver=solver, simulated=False, evaluate_every=1)
    for number in range(10):
        observer.refreshed(refresh(number, solved))
    assert len(solver.orders) == 1  # the solver's thread draws when it comes to it
    solver.draw()
    assert wait_for_all(120.0) == 0
    observer.refreshed(refresh(10, solved))
    assert observer.summary()["quality_frames"] == 1


@pytest.mark.parametrize(("share", "begun"), [(1.0, True), (1e-9, False)])
def test_measuring_takes_only_its_share_of_a_real_time_run(
    share: float, begun: bool, content: ContentSource, solved: Solution, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sampling, "MEASURING_SHARE", share)
    solver = Drawing(content, at_once=False)
    observer, _ = looking(content, solver=solver, simulated=False, evaluate_every=1)
    observer.refreshed(refresh(0, solved))
    solver.draw()
    assert wait_for_all(120.0) == 0
    observer.refreshed(refresh(1, solved))
    assert len(solver.orders) == begun


def test_a_few_samples_that_came_meanwhile_are_measured_at_the_end(content: ContentSource, solved: Solution) -> None:
    solver = Drawing(content, at_once=False)
    observer, _ = looking(content, solver=solver, simulated=False, evaluate_every=1)
    for number in range(2 * sampling.HELD_MAX):
        observer.sampled(sample(NS_PER_S + number * PERIOD_NS))
        observer.refreshed(refresh(number, solved))
    solver.draw()  # the first one's
    solver.at_once = True
    observer.finish()
    last = 2 * sampling.HELD_MAX - 1
    assert set(observer.live_errors) > {0, last} and len(observer.live_errors) == 1 + sampling.HELD_MAX
    assert observer.moment is not None and observer.moment.lines[0].startswith(f"Refresh {last}:")


def test_another_process_finds_the_same_figures_and_its_end_costs_one(content: ContentSource, solved: Solution) -> None:
    inline, _ = looking(content, evaluate_every=1)
    inline.refreshed(refresh(0, solved))
    observer, _ = looking(content, simulated=False, evaluate_every=1)
    observer.refreshed(refresh(0, solved))
    assert wait_for_all(120.0) == 0
    observer.finish(lambda: True)
    assert observer.measured == inline.measured
    assert observer.moment is not None and inline.moment is not None
    np.testing.assert_array_equal(observer.moment.layers, inline.moment.layers)

    process = made[-1]
    later = refresh(1, solved)
    job = Comparison(later.account, later.frame, RefreshTargets(FOV_DEG), for_page=False, state_version=0)
    (used,) = process.status()
    pid = used["pid"]
    assert os.getpriority(os.PRIO_PROCESS, pid) == BACKGROUND_NICENESS
    os.kill(pid, signal.SIGSTOP)
    Timer(0.2, os.kill, (pid, signal.SIGKILL)).start()
    assert process.compared(job) is None
    assert eventually(lambda: process.compared(job) is not None)


# --- live quality ------------------------------------------------------------------------------------------------


def live_db(content: ContentSource, seen: Refresh, true_m: Any, *, time_ns: int = 0) -> float:
    """The contract's definition, by the function that `solve` measures light with."""
    pictures = retina_pictures(content, true_m, SMALL, fov_deg=FOV_DEG, time_ns=time_ns)
    layers = shown_layers(seen.frame)
    light = expected_psnrs_db(layers, pictures, SMALL, eyes_m=true_m, fov_deg=FOV_DEG, sigmas_mm=(0.0,))
    return light[0.0]


def test_live_quality_counts_a_stale_view_where_carried_quality_does_not(
    content: ContentSource, solved: Solution
) -> None:
    figures = []
    for stale_m in (0.0, 0.05):
        observer, _ = looking(content, evaluate_every=1)
        observer.sampled(sample(NS_PER_S + PERIOD_NS, y_m=stale_m))
        seen = refresh(1, solved, eyes_m=aside(stale_m))  # aligned perfectly
        observer.refreshed(seen)
        summary = observer.summary()
        assert summary["live_db"] == pytest.approx(live_db(content, seen, aside(stale_m)), abs=0.1)
        assert summary["view_error_mm"]["p50"] == pytest.approx(1000 * stale_m)
        figures.append(summary)
    still, stale = figures
    assert stale["live_db"] < still["live_db"] - 4
    assert stale["carried_db_true_eyes"] > still["carried_db_true_eyes"] - 1


def test_live_quality_is_one_mean_squared_error_in_whatever_state(content: ContentSource, solved: Solution) -> None:
    observer, _ = looking(content, evaluate_every=1)
    tracked, held = refresh(0, solved), refresh(1, solved, state=State.HOLDING, eyes_m=aside(0.02))
    flat = refresh(2, solved, state=State.FLAT)
    flat = replace(flat, frame=replace(flat.frame, flat=255 - solved.layers, flat_version=2, flatness=0.5))
    refreshes = [tracked, held, flat, refresh(3, solved)]
    for seen in refreshes[:3]:
        observer.sampled(sample(seen.account.photon_ns, y_m=0.004))
        observer.refreshed(seen)
    observer.finish()
    observer.refreshed(refreshes[3])  # unknown eyes do not count as a viewer
    decibels = [live_db(content, seen, aside(0.004)) for seen in refreshes[:3]]
    errors = [10 ** (-each / 10) for each in decibels]
    assert observer.summary()["live_db"] == pytest.approx(-10 * np.log10(np.mean(errors)), abs=0.1)
    assert (observer.summary()["live_frames"], observer.summary()["quality_frames"]) == (3, 2)
    assert observer.live_errors == pytest.approx(dict(enumerate(errors)), rel=0.05)  # fewer rays, 192 pixels across


class Moving(ContentSource):
    """A grey that gets lighter, a code every millisecond."""

    def __init__(self) -> None:
        self.info = ContentInfo("moving", moving=True, background=None)

    def render(self, view: View, *, time_ns: int) -> Any:
        return np.full((view.height_px, view.width_px, 4), time_ns // NS_PER_MS % 256, np.uint8)


def test_live_targets_are_drawn_for_the_display_time(solved: Solution) -> None:
    content = Moving()
    observer, kept = looking(content, evaluate_every=1, keep_light=1)
    seen = refresh(1, solved)
    observer.sampled(sample(seen.account.photon_ns))
    observer.refreshed(seen)
    observer.finish()
    now_ns = seen.account.photon_ns
    assert observer.summary()["live_db"] == pytest.approx(live_db(content, seen, EYES, time_ns=now_ns), abs=0.1)
    assert np.unique(kept.lights[1]["true"]) == [now_ns // NS_PER_MS % 256]
    assert np.unique(kept.lights[1]["drawn"]) == [0]  # solved for instant 0


def test_the_view_error_covers_every_refresh_with_known_eyes(content: ContentSource, solved: Solution) -> None:
    observer, _ = looking(content)
    observer.sampled(sample(NS_PER_S, y_m=0.010))
    for number in range(101):
        observer.refreshed(refresh(number, solved if number else None, eyes_m=aside(0.3)))
    observer.sampled(sample(NS_PER_S + 5 * PERIOD_NS, y_m=0.015))
    observer.finish()
    assert observer.summary()["view_error_mm"] == pytest.approx({"p50": 13.0, "p95": 14.8})  # of refreshes 1 to 5


def test_a_coarse_solution_is_measured_as_the_panels_show_it(content: ContentSource, solved: Solution) -> None:
    observer, kept = looking(content, evaluate_every=1, keep_light=1)
    coarse = replace(solved, layers=np.ascontiguousarray(solved.layers[:, ::2, ::2]))
    seen = refresh(1, coarse, eyes_m=aside(0.01))
    seen = replace(seen, frame=replace(seen.frame, size_px=(SMALL.width_px, SMALL.height_px)))
    observer.sampled(sample(seen.account.photon_ns, y_m=0.01))
    observer.refreshed(seen)
    assert observer.summary()["live_db"] == pytest.approx(live_db(content, seen, aside(0.01)), abs=0.15)
    assert observer.moment is not None
    shape = (SMALL.count, SMALL.height_px, SMALL.width_px, 4)
    assert kept.lights[1]["layers"].shape == observer.moment.layers.shape == observer.moment.solution.shape == shape


def test_a_reload_draws_the_new_scene_in_its_field_of_view(content: ContentSource, solved: Solution) -> None:
    solver, kept = Drawing(content), Kept()
    drawer, measuring = TargetDrawer(solver), MeasuringProcess(SMALL)
    observer = RunObserver(SMALL, drawer, measuring, evaluate_every=1, keep_light=1, output=kept, simulated=True)
    observer.sampled(sample(NS_PER_S))
    observer.refreshed(refresh(1, solved))
    solver.content, solver.scene, solver.fov_deg = Moving(), 2, 30.0
    observer.sampled(sample(NS_PER_S + 3 * PERIOD_NS))
    observer.refreshed(refresh(2, solved))
    observer.finish()
    assert observer.moment is not None and observer.moment.eye_views.fov_deg == kept.lights[2]["info"]["fov"] == 30.0
    assert list(observer.live_errors) == [2]
    assert (kept.lights[1]["true"], kept.lights[1]["drawn"]) == (None, None)
    assert kept.lights[2]["true"] is not None


class Live:
    """An observer of a live page, whose refreshes are numbered."""

    def __init__(self, content: ContentSource) -> None:
        self.observer, _ = looking(content, simulated=False, newest=True)
        self._numbers = count(1)

    def shown(self, solution: Solution, *, state_version: int = 0, later: int = 0, **changes: Any) -> Refresh:
        """The next refresh, or one that comes `later`."""
        return replace(refresh(next(self._numbers) + later, solution, **changes), state_version=state_version)

    def light(self, solution: Solution, **changes: Any) -> dict[str, Any]:
        """The light that is reported at the next refresh."""
        shown = self.shown(solution, **changes)
        self.observer.refreshed(shown)
        return self.observer.light(shown)

    def db(self, solution: Solution, **changes: Any) -> float | None:
        return self.light(solution, **changes)["light_db"]

    def measured(self, solution: Solution, **changes: Any) -> float:
        """The light at a later refresh, once it is measured."""
        found: list[float | None] = []
        assert eventually(lambda: found.append(self.db(solution, **changes)) or found[-1] is not None)
        assert found[-1] is not None
        return found[-1]


@pytest.fixture
def live(content: ContentSource) -> Live:
    return Live(content)


def test_a_live_figure_applies_to_these_eyes_and_this_state_alone(live: Live, solved: Solution) -> None:
    there: dict[str, Any] = {"eyes_m": aside(0.02)}
    live.measured(solved)
    assert live.db(solved, **there) is None, "the figure of another position"
    live.measured(solved, **there)
    stale = live.light(solved, **there, state_version=1)
    assert stale["light_db"] is None, "the scene or the model has changed, and the panels still show the old solution"
    assert stale["light_age_s"] is None
    live.measured(replace(solved, number=2, state_version=1), **there, state_version=1)
    assert live.db(solved, **there) is None


def test_a_live_figure_applies_until_either_of_two_people_moves(live: Live, solved: Solution) -> None:
    def people(*places: Any) -> dict[str, Any]:
        return {"people": tuple(PersonAccount(number, eyes_m, eyes_m) for number, eyes_m in enumerate(places, start=1))}

    live.measured(solved, **people(EYES, aside(0.2)))
    assert live.db(solved, **people(EYES, aside(0.22))) is None
    assert live.db(solved, **people(EYES)) is None


def test_a_live_figure_falls_where_depth_is_seen_from_elsewhere(live: Live, solved: Solution) -> None:
    assert live.measured(solved) - live.measured(solved, eyes_m=aside(0.15)) > 5


def test_a_live_figure_has_an_age_and_follows_a_better_solution(live: Live, solved: Solution) -> None:
    live.measured(solved)
    first = live.light(solved)["measured_frame"]
    later = live.shown(solved, later=100)
    age_s = (later.account.frame - first) * PERIOD_NS / NS_PER_S
    assert live.observer.light(later)["light_age_s"] == pytest.approx(age_s, abs=0.06)
    assert eventually(lambda: live.light(replace(solved, number=2))["measured_frame"] != first)


@pytest.mark.parametrize(("settled_s", "has_figure"), [(0.0, False), (600.0, True)])
def test_a_refined_solution_that_stays_on_the_panels_has_no_old_figure(
    live: Live, solved: Solution, monkeypatch: pytest.MonkeyPatch, settled_s: float, has_figure: bool
) -> None:
    monkeypatch.setattr(sampling, "SETTLED_S", settled_s)
    live.measured(solved)
    refined = replace(solved, number=2)
    assert (live.db(refined) is not None) == has_figure
    live.measured(refined)


# --- kept light --------------------------------------------------------------------------------------------------


def test_every_nth_refresh_leaves_what_a_judge_needs(content: ContentSource, solved: Solution) -> None:
    solver = Drawing(content, at_once=False)
    observer, kept = looking(content, solver=solver, keep_light=4)
    shown = {}
    for number in range(12):
        seen = refresh(number, solved, eyes_m=aside(number / 500))
        shown[number] = shown_layers(seen.frame)
        observer.sampled(sample(seen.account.photon_ns, y_m=number / 400))
        observer.refreshed(seen)
    assert list(kept.lights) == [3, 7, 11]
    assert solver.orders == [], "drawing waits for the end of the run"
    solver.at_once = True
    observer.finish()
    drawn = retina_pictures(content, EYES, SMALL, fov_deg=FOV_DEG, time_ns=0)
    for number, light in kept.lights.items():
        assert np.array_equal(light["layers"], shown[number])
        assert all(np.array_equal(a, b) for a, b in zip(light["drawn"], drawn, strict=True))
        true = retina_pictures(content, light["info"]["true_eyes_m"], SMALL, fov_deg=FOV_DEG, time_ns=0)
        assert all(np.array_equal(a, b) for a, b in zip(light["true"], true, strict=True))
        info = light["info"]
        assert set(info) == {"solved_for_m", "eyes_m", "true_eyes_m", "fov", "people"}
        assert np.array_equal(info["eyes_m"], aside(number / 500))
        assert np.array_equal(info["solved_for_m"], EYES)
        assert info["true_eyes_m"] == pytest.approx(aside(number / 400))
        assert info["fov"] == FOV_DEG


def test_a_live_sensor_s_pictures_are_drawn_during_the_run(content: ContentSource, solved: Solution) -> None:
    observer, kept = looking(content, simulated=False, keep_light=1)
    observer.refreshed(refresh(1, solved))
    assert wait_for_all(120.0) == 0
    assert kept.lights[1]["drawn"] is not None and kept.lights[1]["true"] is None
    assert kept.lights[1]["info"]["true_eyes_m"] is None


@pytest.mark.parametrize("count_drawn", [0, 1])
def test_who_stops_a_run_waits_for_no_kept_picture(
    content: ContentSource, solved: Solution, caplog: pytest.LogCaptureFixture, count_drawn: int
) -> None:
    solver = Drawing(content, at_once=count_drawn > 0)
    observer, kept = looking(content, solver=solver, keep_light=1)
    for number in range(3):
        observer.sampled(sample(NS_PER_S + number * PERIOD_NS))
        observer.refreshed(refresh(number, solved))

    def stopped() -> bool:
        """At once, or when the first is drawn and the solver is busy with the second."""
        solver.at_once = count_drawn > 0 and "drawn" not in kept.lights[0]
        return count_drawn == 0 or bool(solver.orders)

    observer.finish(stopped)
    assert f"{3 - count_drawn} of 3 refreshes kept by --keep-light have no" in caplog.text
    assert all({"layers", "info"} <= light.keys() for light in kept.lights.values())
    assert [light.get("drawn") is not None for light in kept.lights.values()] == [n < count_drawn for n in range(3)]
    assert kept.lights[2]["info"]["true_eyes_m"] is not None
