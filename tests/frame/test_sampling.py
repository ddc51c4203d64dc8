"""Tests which refreshes are measured and when, on a test's clock and with a test's figures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from runtime.evaluation.refresh_quality import RefreshQuality
from runtime.frame import sampling
from runtime.frame.refresh import Refresh
from runtime.frame.sampling import QualitySampler, applies_to, is_measurable
from runtime.frame.truth import TrueEyes
from runtime.records import PersonAccount, State
from tests.frame.conftest import SMALL
from tests.frame.fakes import EYES, aside, solution
from tests.frame.test_observer import refresh


class Job:
    """A job in the background, done once a test says so."""

    are_done = True

    def __init__(self, name: str, work: Callable[[], Any]) -> None:
        self.take = work

    @property
    def done(self) -> bool:
        return Job.are_done


class Sampled:
    """A sampler, and what it works with. Pictures are drawn once `draw` is called, or while it waits."""

    def __init__(self, *, every: int = 1, simulated: bool = False, newest: bool = False) -> None:
        self.now_s, self.scene, self.may_focus = 0.0, 1, False
        self.orders: list[Callable[[Any], None]] = []
        self.draws_from_s: float | None = None
        self.shown: Refresh
        self.errors: dict[int, float] = {0: 1e-3}
        self.measured: list[int] = []
        self.truth = TrueEyes()
        worker, drawer = cast(Any, SimpleNamespace(compared=self.compared)), cast(Any, self)
        self.sampler = QualitySampler(
            SMALL, drawer, self.truth, worker, every=every, simulated=simulated, newest=newest
        )

    def draw(self, wanted: Any = None, scene: Any = None, then: Any = None) -> None:
        self.orders.append(then)
        if self.draws_from_s == 0.0:
            self.drawn()

    def drawn(self) -> None:
        self.orders.pop(0)(SimpleNamespace())

    def look(self) -> None:
        if self.draws_from_s is not None and self.orders and self.now_s >= self.draws_from_s:
            self.drawn()

    def monotonic(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds

    def compared(self, comparison: Any) -> RefreshQuality:
        account = comparison.account
        self.measured.append(account.frame)
        moment = SimpleNamespace(account=account, state_version=comparison.state_version)
        error = next(iter(self.errors.values()))
        return RefreshQuality({"psnr_db": 30.0 + account.frame}, error, self.errors, cast(Any, moment))

    def shows(self, number: int, *, at_s: float = 0.0, of: int = 1, **changes: Any) -> int:
        """Refresh at a time, and return how many refreshes' pictures have been ordered and not been drawn."""
        self.now_s = at_s
        self.shown = refresh(number, solution(of), **changes)
        self.sampler.refreshed(self.shown)
        self.sampler.advance()
        return len(self.orders)


@pytest.fixture
def of(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Sampled]:
    """Makes a sampler."""
    monkeypatch.setattr(sampling, "BackgroundJob", Job)
    monkeypatch.setattr(Job, "are_done", True)

    def made(**how: Any) -> Sampled:
        sampled = Sampled(**how)
        monkeypatch.setattr(sampling, "time", sampled)
        monkeypatch.setattr(sampling, "compared", lambda comparison, stack: sampled.compared(comparison))
        return sampled

    return made


def test_measuring_is_followed_by_a_pause_in_proportion(of: Callable[..., Sampled]) -> None:
    """A tenth of a run is spent on it, and three tenths of a live page's, here with a new solution at each refresh."""
    sampled = of()
    assert sampled.shows(0) == 1
    sampled.now_s = 1.5
    sampled.drawn()
    assert sampled.shows(1, at_s=2.0) == sampled.shows(2, at_s=19.99) == 0 and sampled.measured == [0]
    assert sampled.shows(3, at_s=20.01) == 1
    sampled = of(newest=True)
    assert [sampled.shows(n, at_s=n / 10, of=n) for n in range(4)] == [0, 0, 0, 1]
    sampled.drawn()
    assert [sampled.shows(n, at_s=n / 10, of=n) for n in (23, 30, 40, 50, 60, 69)] == [0] * 6
    assert sampled.measured == [3] and sampled.shows(70, at_s=7.0, of=70) == 1


def test_a_live_figure_is_measured_again_once_out_of_date(of: Callable[..., Sampled]) -> None:
    sampled = of(newest=True)

    def ordered(at_s: float, *, solution: int = 1, **changes: Any) -> int:
        """Measurements that are begun at a refresh. Each takes half a second."""
        count = sampled.shows(round(100 * at_s), at_s=at_s, of=solution, **changes)
        for _ in range(count):
            sampled.drawn()
            sampled.now_s += 0.5
        sampled.sampler.advance()
        return count

    def has_figure() -> bool:
        return sampled.sampler.figure_of(sampled.shown) is not None

    there: dict[str, Any] = {"eyes_m": aside(0.0021)}
    assert ordered(0.0) == ordered(0.25) == 0 and not has_figure()
    assert ordered(0.26, eyes_m=aside(0.0019)) == 0 and ordered(0.31) == 1 and has_figure(), "eyes that tremble rest"
    assert ordered(0.9) == 0 and has_figure()
    assert ordered(1.0, **there) == ordered(1.25, **there) == 0 and not has_figure()
    assert ordered(1.31, **there) == 1 and has_figure(), "at once, whatever the share of the run"
    assert ordered(1.9, **there, solution=2) == ordered(2.85, **there, solution=2) == 0 and has_figure()
    assert ordered(2.91, **there, solution=2) == 1 and has_figure(), "it has been shown for a second"
    assert ordered(3.5, **there, solution=2, state=State.HOLDING) == 0 and not has_figure()
    assert ordered(70.0, **there, solution=2) == 0 and has_figure()


@pytest.mark.parametrize(("most", "others"), [(9, 4), (3, 2)])
def test_of_refreshes_due_meanwhile_the_newest_and_a_few_others_are_measured(
    of: Callable[..., Sampled], monkeypatch: pytest.MonkeyPatch, most: int, others: int
) -> None:
    """At most five, or as many as have few bytes."""
    monkeypatch.setattr(sampling, "HELD_BYTES", most * solution(1).layers.nbytes)
    sampled = of()
    sampled.shows(0)
    sampled.drawn()
    Job.are_done = False
    for number in range(1, 40):
        assert sampled.shows(number, at_s=number / 10) == 0
    Job.are_done, sampled.draws_from_s = True, 4.0
    sampled.sampler.drain(lambda: False)
    first, newest, *later = sampled.measured
    assert (first, newest, len(later)) == (0, 39, others) and later == sorted(later, reverse=True)
    assert later != [38, 37, 36, 35][:others], "not only the latest"
    moment = sampled.sampler.moment
    assert moment is not None and moment.account is not None and moment.account.frame == 39
    assert sampled.sampler.summary()["psnr_db"] == pytest.approx(30 + np.mean(sampled.measured), abs=0.001)
    assert sampled.sampler.summary()["quality_frames"] == 2 + others


def test_after_the_run_a_minute_is_the_most_that_is_waited(of: Callable[..., Sampled]) -> None:
    for is_stopped, waited_s in ((False, 60.0), (True, 0.0)):
        sampled = of()
        sampled.shows(0)
        sampled.sampler.drain(lambda is_stopped=is_stopped: is_stopped)
        assert sampled.now_s == pytest.approx(waited_s, abs=0.05)
    for draws_from_s, waited_s in ((None, 30.0), (2.0, 2.0)):
        sampled = of()
        sampled.draws_from_s = draws_from_s
        sampled.sampler.finish(refresh(0, solution(1)))
        assert sampled.now_s == pytest.approx(waited_s, abs=0.05)
        assert sampled.measured == ([] if draws_from_s is None else [0])


@pytest.mark.parametrize(("simulated", "begun"), [(True, [0]), (False, [2])])
def test_a_refresh_waits_for_its_true_eyes_unless_a_page_is_live(
    of: Callable[..., Sampled], simulated: bool, begun: list[int]
) -> None:
    sampled = of(simulated=simulated)
    sampled.truth.add(0, EYES)
    assert [sampled.shows(number) for number in range(3)] == [0, 0, 0]
    sampled.truth.add(sampled.shown.account.photon_ns, EYES)
    sampled.sampler.advance()
    sampled.drawn()
    sampled.sampler.advance(at_once=True)
    assert sampled.measured[:1] == begun
    live = of(newest=True)
    live.truth.add(0, EYES)
    assert [live.shows(number, at_s=number) for number in range(2)] == [0, 1]


@pytest.mark.parametrize(
    ("errors", "live_db", "of_people"),
    [
        ([], None, {}),
        ([{0: 1e-3}, {0: 3e-3}], 26.99, {}),
        ([{0: 1e-3}, {1: 3e-3}], 26.99, {1: 26.99}),  # the only person was there before being served
        ([{0: 1e-3}, {1: 3e-3, 2: 1e-2}], 26.99, {1: 25.229, 2: 20.0}),
    ],
)
def test_live_quality_is_the_mean_error_s_and_each_person_s(
    of: Callable[..., Sampled], errors: list[dict[int, float]], live_db: float | None, of_people: dict[int, float]
) -> None:
    sampled = of(simulated=True)
    for number, each in enumerate(errors):
        sampled.errors = each
        sampled.shows(number)
        sampled.drawn()
    assert sampled.sampler.live_db == live_db
    assert sampled.sampler.live_db_of_people == pytest.approx(of_people, abs=0.001)
    assert (sampled.sampler.summary()["live_frames"], len(sampled.sampler.live)) == (len(errors),) * 2


@pytest.mark.parametrize(
    ("before", "state", "figures", "live"),
    [(False, State.TRACKING, 1, 1), (False, State.HOLDING, 0, 1), (True, State.TRACKING, 1, 1)],
)
def test_the_last_refresh_counts_if_no_other_was_measured(
    of: Callable[..., Sampled], before: bool, state: State, figures: int, live: int
) -> None:
    sampled = of(simulated=True)
    sampled.draws_from_s = 0.0  # at once
    if before:
        sampled.shows(0)
    sampled.sampler.finish(refresh(7, solution(1), state=state))
    assert (len(sampled.sampler.measured.get("psnr_db", [])), len(sampled.sampler.live)) == (figures, live)
    moment = sampled.sampler.moment
    assert moment is not None and moment.account is not None and moment.account.frame == 7


def people(*places: Any) -> dict[str, Any]:
    return {"people": tuple(PersonAccount(number, eyes_m, eyes_m) for number, eyes_m in enumerate(places, start=1))}


@pytest.mark.parametrize(
    ("account", "others", "measurable", "applies"),
    [
        ({}, {}, True, True),
        ({"state": State.HOLDING}, {}, False, False),
        ({}, {"solution": None}, False, False),
        ({}, {"solution": solution(1, None)}, False, False),
        ({}, {"solution": solution(1, EYES[[0, 0]], seeing=(True, False))}, False, False),
        ({}, {"state_version": 1}, False, False),
        ({}, {"state_version": 1, "solution": solution(1, state_version=1)}, True, False),
        (people(aside(0.0019), aside(0.3, z_m=-0.0019)), {}, True, True),
        (people(EYES, aside(0.3, z_m=-0.0021)), {}, True, False),
        (people(aside(0.0021), aside(0.3)), {}, True, False),
    ],
)
def test_a_figure_applies_to_a_tracked_viewer_s_same_eyes_and_state(
    account: dict[str, Any], others: dict[str, Any], measurable: bool, applies: bool
) -> None:
    seen = refresh(1, solution(1))
    before = replace(seen.account, **(people(EYES, aside(0.3)) if "people" in account else {}))
    seen = replace(replace(seen, account=replace(before, **account)), **others)
    assert is_measurable(seen) == measurable
    assert applies_to(cast(Any, SimpleNamespace(account=before, state_version=0)), seen) == applies
