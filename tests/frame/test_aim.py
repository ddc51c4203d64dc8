"""Tests of requests: for the middle of the refreshes that will show a solution, and with a suitable effort."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar, cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.clock import NS_PER_MS, NS_PER_S
from runtime.config import Settings
from runtime.frame import aim
from runtime.frame.aim import Aim, Slots, focused
from runtime.frame.effort import Costs, EffortChooser, Outlook, simulated_costs
from runtime.frame.viewer import Viewer
from runtime.model.solver import FOCUS_STEPS
from runtime.records import Effort, EyesEstimate, EyesLabel, FrameTiming, Measures, Solution, SolveRequest
from tests.frame.fakes import EYES, FakeSolver, facts, solution

PERIOD_NS = 16_000_000


@given(cost_ns=st.integers(1, 400_000_000), wait_ns=st.integers(0, PERIOD_NS))
def test_the_middle_is_that_of_the_refreshes_between_two_solutions(cost_ns: int, wait_ns: int) -> None:
    composed_ns, photon_ns = 10**9, 10**9 + 25_000_000
    refreshes = np.arange(1, 60)  # later ones than the current refresh
    done_ns = composed_ns + wait_ns + cost_ns
    composed = composed_ns + refreshes * PERIOD_NS
    showing = refreshes[(composed >= done_ns) & (composed < done_ns + cost_ns)]
    if not showing.size:  # the next solution is complete before a refresh, but the request cannot know
        showing = refreshes[composed >= done_ns][:1]
    expected_ns = photon_ns + showing.mean() * PERIOD_NS
    slots = Slots(photon_ns, composed_ns, composed_ns + wait_ns, PERIOD_NS)
    assert abs(slots.middle_ns(cost_ns) - expected_ns) <= 1


@pytest.mark.parametrize(
    ("done", "step_ms", "most", "gets"),
    [
        (Effort(1, 6), 2.0, 8, True),
        (Effort(2, 6), 2.0, 8, False),  # a finer raster comes first
        (Effort(1, 8, focus=True), 2.0, 8, False),
        (Effort(1, 6), 15.0, 8, False),  # 16 steps of 45 ms are more than a quarter of two seconds
        (Effort(1, 6), 2.0, 0, False),  # a model without steps
    ],
)
def test_a_resting_head_s_finished_solution_gets_focus_if_time_allows(
    done: Effort, step_ms: float, most: int, gets: bool
) -> None:
    shown = Solution(1, np.zeros((3, 2, 2, 4), np.uint8), EYES, 0, effort=done)
    costs = Costs({1: {"render": 1.0, "step": step_ms}, 2: {"render": 0.3, "step": 0.5}})
    effort = focused(shown, most, costs, horizon_s=2.0)
    assert effort == (Effort(1, FOCUS_STEPS, focus=True) if gets else None)


NOW_NS, REFRESH_NS = 2 * NS_PER_S, 20 * NS_PER_MS
PHOTON_NS = NOW_NS + 30 * NS_PER_MS


class Looking:
    """A viewer whose eyes at a time, in ms from the display time, are a test's."""

    def __init__(self, eyes: Callable[[float], EyesEstimate]) -> None:
        self.eyes, self.asked_ms = eyes, list[float]()

    def ahead(self, time_ns: int) -> EyesEstimate:
        self.asked_ms.append((time_ns - PHOTON_NS) / NS_PER_MS)
        return self.eyes(self.asked_ms[-1])


class Busy(FakeSolver):
    """A solver that is free at some time, and whose model offers more."""

    def __init__(self, *, free_ms: float = 0.0, cost_ms: float = 20.0, step_ms: float = 0.0, **offered: Any) -> None:
        super().__init__()
        self.free_ms, self.offers = free_ms, {"steps": 4, "refined_steps": 8, "reductions": (1,), **offered}
        self.reductions, self.stage_ms = self.offers["reductions"], {"inference": cost_ms, "step": step_ms}

    costs = property(lambda self: simulated_costs(self.stage_ms, self.reductions))
    facts = property(lambda self: facts(self.settings, **self.offers))

    def free_ns(self, now_ns: int) -> int:
        return NOW_NS + round(self.free_ms * NS_PER_MS)


class Recorded(EffortChooser):
    """A chooser of efforts that keeps what it was asked, and always gives the first one."""

    made: ClassVar[list[Recorded]] = []

    def __init__(self) -> None:
        super().__init__()
        self.asked: list[dict[str, Any]] = []
        self.made.append(self)

    def choose(self, efforts: list[Effort], costs: Costs, outlook: Any, **how: float) -> Effort:  # type: ignore[override]
        self.asked.append({"outlook": outlook, **how})
        return efforts[0]


@pytest.fixture(autouse=True)
def chooser_recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(aim, "EffortChooser", Recorded)


class Aiming:
    """An aim of a solver at a viewer's eyes, in refreshes of 20 ms."""

    def __init__(self, eyes: Callable[[float], EyesEstimate], *, fixed: Effort | None = None, **solver: Any) -> None:
        self.viewer, self.solver = Looking(eyes), Busy(**solver)
        self.aim = Aim(cast(Viewer, self.viewer), self.solver, period_ns=REFRESH_NS, fixed=fixed)
        self.chooser = Recorded.made[-1]

    def request(self, shown: Solution | None = None, *, later_s: float = 0.0, **settings: Any) -> SolveRequest:
        timing = FrameTiming(1, NOW_NS, NOW_NS + REFRESH_NS, PHOTON_NS + round(later_s * NS_PER_S))
        eyes, times = self.viewer.eyes(1e3 * later_s), {"composed_ns": NOW_NS, "now_ns": NOW_NS}
        told = Settings.model_validate(settings)
        return self.aim.request(timing, eyes, shown, told, **times, flat_wanted=False, paused=False)

    def outlook(self, eyes: Callable[[float], EyesEstimate], *, cost_ms: float = 20.0, requests: int = 1) -> Outlook:
        """The outlook after so many requests for these eyes."""
        self.viewer.eyes = eyes
        for _ in range(requests):
            self.request()
        return cast(Outlook, self.chooser.asked[-1]["outlook"](cost_ms))


def seen(*places_m: Any, sigma_mm: float = 1.0, label: EyesLabel = "predicted", first: int = 1) -> EyesEstimate:
    """Estimate of one or more people's eyes, each displaced from `EYES`; nobody without places."""
    if not places_m:
        return EyesEstimate(0, 0, None, "none")
    eyes_m = np.concatenate([EYES + np.array(place) for place in places_m])
    return EyesEstimate(0, 0, eyes_m, label, sigma_mm / 1e3, tuple(range(first, first + len(places_m))))


def walking(m_s: float, *, label: EyesLabel = "predicted", least_mm: float = 1.0) -> Callable[[float], EyesEstimate]:
    """A head that moves along y, and grows uncertain by 1 mm in 20 ms."""
    return lambda ms: seen((0.0, m_s * ms / 1e3, 0.0), sigma_mm=least_mm + ms / 20, label=label)


@pytest.mark.parametrize(
    ("cost_ms", "free_ms", "middle_ms"),
    [
        (20.0, 10.0, 40.0),
        (20.0, 500.0, 40.0),  # a newer request will have replaced it, so it begins with the next refresh at the latest
        (20.0, -500.0, 20.0),
    ],
)
def test_a_solution_is_for_the_middle_of_its_showing(cost_ms: float, free_ms: float, middle_ms: float) -> None:
    aiming = Aiming(walking(0.0), cost_ms=cost_ms, free_ms=free_ms)
    assert (aiming.request().time_ns - PHOTON_NS) / NS_PER_MS == middle_ms


@pytest.mark.parametrize(
    ("reaches_mm", "others_mm", "sigma_mm", "label", "shares"),
    [
        (20.0, 0.0, 0.0, "predicted", (1.0, 1.0)),
        (20.0, 0.0, 200.0**0.5, "predicted", (0.5, 1.0)),  # half of it may be an error
        (20.0, 40.0, 200.0**0.5, "predicted", (0.5, 0.8)),  # each person's own share
        (20.0, 0.0, 200.0**0.5, "rested", (1.0, 1.0)),
    ],
)
def test_as_much_of_a_movement_is_believed_as_is_no_error(
    reaches_mm: float, others_mm: float, sigma_mm: float, label: EyesLabel, shares: tuple[float, float]
) -> None:
    def eyes(ms: float) -> EyesEstimate:
        moves = (0.0, reaches_mm / 1e3 * (ms > 0), 0.0), (0.0, 0.5 + others_mm / 1e3 * (ms > 0), 0.0)
        return seen(*moves, sigma_mm=sigma_mm if ms > 0 else 7.0, label=label)

    request = Aiming(eyes, cost_ms=20.0).request()
    expected = np.array([shares[0] * reaches_mm, 500 + shares[1] * others_mm]) / 1e3
    assert request.eyes_m is not None
    assert (request.eyes_m - np.tile(EYES, (2, 1)))[::2, 1] == pytest.approx(expected)
    assert (request.sigma_m, request.eyes_label, request.people) == (0.007, label, (1, 2))


def test_eyes_are_predicted_an_eighth_of_a_second_ahead_at_most() -> None:
    for cost_ms, reach_ms in ((60.0, 80.0), (120.0, 125.0)):
        aiming = Aiming(walking(1.0, least_mm=0.0), cost_ms=cost_ms, reductions=(1,))
        aiming.request(model={"effort": "full"})
        assert aiming.viewer.asked_ms == [reach_ms]
    gone = Aiming(lambda ms: seen((0, 0, 0), first=1) if ms <= 0 else seen((0, 0.1, 0), first=2))
    request = gone.request()
    assert request.eyes_m == pytest.approx(EYES) and request.people == (1,), "another person's eyes are not taken"


def test_an_effort_is_chosen_for_a_viewer_unless_it_is_fixed() -> None:
    full: dict[str, Any] = {"model": {"effort": "full"}}
    assert Aiming(walking(0.0), reductions=(2, 3)).request().effort == Effort(2, 0)
    assert Aiming(walking(0.0), reductions=(2, 3)).request(**full).effort == Effort(1, 4)
    assert Aiming(walking(0.0), fixed=Effort(2, 3)).request(**full).effort == Effort(2, 3)
    assert Aiming(lambda ms: seen(), reductions=(2, 3)).request().effort == Effort(1, 4)


def test_a_lost_head_keeps_its_effort_while_the_model_has_it() -> None:
    aiming = Aiming(walking(0.0), reductions=(2, 3))

    def reduction(*offered: int, label: EyesLabel = "held") -> int:
        aiming.viewer.eyes = walking(0.0, label=label)
        aiming.solver.offers["reductions"] = aiming.solver.reductions = offered
        effort = aiming.request().effort
        return 0 if effort is None else effort.reduction

    assert [reduction(2, 3), reduction(3, 2), reduction(3), reduction(2, 3)] == [2, 2, 3, 3]
    assert reduction(2, 3, label="predicted") == 2


def test_the_outlook_has_the_speed_and_a_deviation_that_grows() -> None:
    soon, late = (Aiming(walking(1.0)).outlook(walking(1.0), cost_ms=cost_ms) for cost_ms in (20.0, 100.0))
    speed_m_s = (0.020**2 - 2 * 0.001**2) ** 0.5 / 0.020  # some of the movement may be an error
    assert soon == Outlook(pytest.approx(0.002), pytest.approx(speed_m_s), 0.0)
    lag_m = 0.015 * speed_m_s  # it is shown from 100 to 180 ms, and eyes are predicted 125 ms ahead
    assert late == Outlook(pytest.approx(0.008), pytest.approx(speed_m_s), pytest.approx(lag_m))
    both = Aiming(walking(1.0)).outlook(lambda ms: seen((0, ms / 1e3, 0), (0, 0.5 + ms / 1e3, 0), sigma_mm=1 + ms / 20))
    speed_m_s = (0.020**2 - 2 * 0.003**2) ** 0.5 / 0.020
    assert both == Outlook(pytest.approx(0.006), pytest.approx(speed_m_s), 0.0), "errors count three times for two"


def test_a_resting_head_has_no_error_a_lost_one_its_usual_speed() -> None:
    aiming = Aiming(walking(1.0))
    usual_m_s = aiming.outlook(walking(1.0), requests=100).speed_m_s
    assert 0.95 * usual_m_s < aiming.outlook(walking(0.0)).speed_m_s < usual_m_s, "at a turning point"
    lost = aiming.outlook(lambda ms: seen((0, 0, 0), sigma_mm=5.0) if ms <= 0 else seen())
    assert 0.95 * usual_m_s < lost.speed_m_s < usual_m_s and (lost.sigma_m, lost.lag_m) == (0.005, 0.0)
    assert aiming.outlook(walking(0.0, label="rested"), cost_ms=200.0) == Outlook()
    assert aiming.outlook(lambda ms: seen((0, 0, 0)) if ms <= 0 else seen()).speed_m_s == 0.0, "it has rested since"


def test_the_usual_speed_follows_a_head_within_half_a_second() -> None:
    aiming = Aiming(walking(1.0, least_mm=0.0))
    aiming.outlook(walking(1.0, least_mm=0.0), requests=13)
    aiming.outlook(walking(0.0, label="held"), requests=20)  # where it was seen last, which is no standing still
    lost = aiming.outlook(lambda ms: seen((0, 0, 0)) if ms <= 0 else seen())
    assert lost.speed_m_s == pytest.approx(0.40**0.5, rel=0.01), "of 0.26 s"


def test_a_calm_head_is_expected_to_stay_calm_as_long_again() -> None:
    aiming = Aiming(walking(0.0))
    for later_s, m_s in ((0.0, 0.019), (0.5, 0.019), (3.0, 0.019), (3.5, 0.021), (4.0, 0.019), (4.5, 0.019)):
        aiming.viewer.eyes = lambda ms, m_s=m_s: seen((0.0, m_s * ms / 1e3, 0.0), sigma_mm=0.0)
        aiming.request(later_s=later_s)
    horizons = [asked["horizon_s"] for asked in aiming.chooser.asked]
    assert horizons == pytest.approx([1.0, 1.5, 4.0, 1.0, 1.0, 1.5], abs=0.001)
    assert aiming.chooser.asked[0]["period_ms"] == 20.0


@pytest.mark.parametrize(
    ("places", "shown", "error"),
    [
        ([(0, 0, 0)], None, 0.03),
        ([(0, 0, 0)], {"effort": None}, 0.03),
        ([(0, 0.004, 0)], {}, 1e-3 + 5.12e-3),  # 4 mm and 100 ms away
        ([(0, 0, 0)], {"people": (7,)}, 1e-3 + 4.386e-3),  # a single person gets the picture that is there
        ([(0, 0, 0)], {"eyes_m": EYES[[0, 0]], "seeing": (True, False)}, 1e-3 + 4.386e-3),  # of whom one eye sees
        ([(0, 0, 0), (0, 0.3, 0)], {}, 0.03),  # the second one waits for a picture
    ],
)
def test_the_shown_error_is_a_stale_view_s_or_that_without_picture(places: Any, shown: Any, error: float) -> None:
    aiming = Aiming(lambda ms: seen(*places))
    aiming.chooser.pictures.rate_s2 = 0.5
    held = None if shown is None else solution(1, time_ns=PHOTON_NS - 100 * NS_PER_MS, **shown)
    aiming.request(held)
    assert aiming.chooser.asked[-1]["shown_error"] == pytest.approx(error, rel=1e-3)


def test_measures_are_learned_once_and_displacements_unless_eyes_are_held() -> None:
    aiming = Aiming(walking(0.0))
    pictures, foresight = aiming.chooser.pictures, aiming.chooser.foresight
    aiming.viewer.eyes = lambda ms: seen((0, 0, 0), sigma_mm=1.0)  # 2 mm² are expected
    request = aiming.request()
    cases: tuple[tuple[EyesLabel, int, float], ...] = ("held", 0, 1.0), ("predicted", 1, 1.0), ("predicted", 0, 0.5)
    for label, off_ns, scale in cases:  # nothing was asked for a nanosecond later
        aiming.viewer.eyes = lambda ms, label=label: seen((0, 0.001, 0), label=label)
        measures = Measures(residual=2e-3 if pictures.residual == 1e-3 else 9e-3)
        aiming.request(solution(3, time_ns=request.time_ns + off_ns, measures=measures))
        assert foresight.scale == pytest.approx(scale)
        assert pictures.residual == 2e-3, "the third solution's measures count once"


def test_expectations_of_the_last_256_requests_are_kept() -> None:
    for requests, scale in ((255, 0.5), (256, 1.0)):
        aiming = Aiming(lambda ms: seen((0, 0, 0)))
        first_ns = aiming.request().time_ns
        for later in range(1, requests + 1):
            aiming.request(later_s=later / 50)
        aiming.viewer.eyes = lambda ms: seen((0, 0.001, 0))
        aiming.request(solution(3, time_ns=first_ns))
        assert aiming.chooser.foresight.scale == pytest.approx(scale)


@pytest.mark.parametrize(
    ("done", "step_ms", "most", "refined"),
    [
        (Effort(2, 0), 1.0, 8, Effort(1, 0)),
        (Effort(1, 1), 1.0, 8, Effort(1, 3, continued_from=1)),  # one step more, or two if they gain more
        (Effort(1, 1), 1.0, 2, Effort(1, 2, continued_from=1)),
        (Effort(1, 3), 1.0, 8, Effort(1, 4, continued_from=3)),
        (Effort(1, 1), 400.0, 8, None),  # for too long, the viewer would see nothing else
        (Effort(1, 6), 1.0, 8, None),  # further steps gain nothing
        (Effort(1, 1), 1.0, 1, None),
    ],
)
def test_a_resting_head_s_solution_is_refined_while_it_gains(
    done: Effort, step_ms: float, most: int, refined: Effort | None
) -> None:
    aiming = Aiming(walking(0.0, label="rested"), reductions=(1, 2), refined_steps=most, step_ms=step_ms)
    off = {"content": {"focus": "off"}}
    shown = solution(1, time_ns=PHOTON_NS, effort=done)
    assert aiming.request(shown, **off).refined_to == refined
    assert aiming.request(None, **off).refined_to is None
    aiming.viewer.eyes = walking(0.0)
    assert aiming.request(shown, **off).refined_to is None, "it does not rest"


@pytest.mark.parametrize(("people", "focus", "gets"), [(1, "auto", True), (1, "off", False), (2, "auto", False)])
def test_one_viewer_at_rest_gets_focus_unless_it_is_off(people: int, focus: str, gets: bool) -> None:
    eyes = seen(*[(0, 0.3 * n, 0) for n in range(people)], label="rested")
    aiming, seeing = Aiming(lambda ms: eyes, cost_ms=1.0), (True, True) * people
    effort = Effort(1, 6)
    shown = solution(1, eyes.eyes_m, time_ns=PHOTON_NS, effort=effort, people=eyes.people, seeing=seeing)
    refined = aiming.request(shown, content={"focus": focus}).refined_to
    assert (refined is not None and refined.focus) == gets
