"""Tests the choice of the next job: a solution, the flat picture or nothing."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.clock import NS_PER_MS
from runtime.frame.policy import Decision, Flatness, FramePolicy, SolutionKey
from runtime.plan.savings import Plan
from runtime.records import Effort, SolveRequest
from tests.frame.fakes import EYES, aside

STILL = Plan((True, True))


def wish(eyes_m: Any = EYES, *, flat: bool = False, paused: bool = False) -> SolveRequest:
    return SolveRequest(0, eyes_m, "none" if eyes_m is None else "predicted", 0.0, flat_wanted=flat, paused=paused)


class Told:
    """A policy with its results so far; each decision is carried out."""

    def __init__(self, *, plan: Plan | None = STILL) -> None:
        self.policy, self.plan = FramePolicy(), plan
        self.version = self.revision = 0
        self.solved: SolutionKey | None = None
        self.flat: SolutionKey | None = None

    def asked(self, request: SolveRequest) -> Decision:
        decision = self.policy.next_job(
            request,
            plan=self.plan,
            state_version=self.version,
            revision=self.revision,
            solved=self.solved,
            flat=self.flat,
        )
        if decision.kind == "solve":
            self.solved = SolutionKey(self.version, self.revision, decision.eyes_m)
        if decision.kind == "flat":
            self.flat = SolutionKey(self.version, self.revision, None, episode=self.policy.episode)
        return decision

    def kinds(self, *requests: SolveRequest) -> list[str]:
        return [self.asked(request).kind for request in requests]


def test_the_flat_picture_comes_first_since_something_must_be_shown_to_nobody() -> None:
    assert Told().kinds(wish(None, flat=True), wish(None, flat=True)) == ["flat", "nothing"]


def test_the_flat_picture_is_made_before_it_is_needed() -> None:
    assert Told().kinds(wish(), wish(), wish()) == ["flat", "solve", "nothing"]


def test_unmoved_eyes_are_solved_for_once_and_others_anew() -> None:
    told = Told()
    assert told.kinds(wish(), wish(), wish(EYES.copy()), wish(aside(1e-9)), wish(aside(1e-9))) == [
        "flat", "solve", "nothing", "solve", "nothing",
    ]  # fmt: skip


@pytest.mark.parametrize("what", ["version", "revision"])
def test_other_settings_and_other_content_are_solved_for_though_the_head_rests(what: str) -> None:
    told = Told()
    told.kinds(wish(), wish())
    setattr(told, what, 1)
    assert told.kinds(wish(), wish()) == ["solve", "nothing"]


def test_paused_makes_nothing_new_whatever_changes_but_the_first_picture() -> None:
    told = Told()
    assert told.kinds(wish(paused=True), wish(paused=True), wish(aside(0.1), paused=True)) == [
        "flat", "solve", "nothing",
    ]  # fmt: skip
    told.version = told.revision = 1
    assert told.asked(wish(aside(0.1), paused=True, flat=True)).kind == "nothing"
    assert told.asked(wish(aside(0.1))).kind == "solve"


def test_the_flat_picture_is_redrawn_whenever_it_is_wanted_again() -> None:
    told = Told()
    told.kinds(wish(), wish())
    assert told.kinds(wish(None, flat=True), wish(None, flat=True), wish(None, flat=True)) == [
        "flat", "nothing", "nothing",
    ]  # fmt: skip
    told.asked(wish())
    assert told.kinds(wish(None, flat=True), wish(None, flat=True)) == ["flat", "nothing"]


def test_with_moving_content_solutions_and_flat_pictures_take_turns() -> None:
    told, kinds = Told(), []
    for revision in range(12):
        told.revision = revision
        kinds.append(told.asked(wish(aside(revision / 1000), flat=True)).kind)
    assert kinds[2:] == ["flat", "solve"] * 5 or kinds[2:] == ["solve", "flat"] * 5


@given(
    st.lists(
        st.tuples(st.sampled_from([None, 0.0, 0.001, 0.05]), st.booleans(), st.booleans(), st.integers(0, 2)),
        min_size=1,
        max_size=40,
    )
)
def test_a_repeated_request_is_soon_satisfied_and_then_nothing_is_done(
    story: list[tuple[float | None, bool, bool, int]],
) -> None:
    told = Told()
    for y_m, flat, paused, revision in story:
        told.revision = revision
        told.asked(wish(None if y_m is None else aside(y_m), flat=flat, paused=paused))
    y_m, flat, _, _ = story[-1]
    settled = told.kinds(*[wish(None if y_m is None else aside(y_m), flat=flat)] * 5)
    assert settled[-2:] == ["nothing", "nothing"]
    assert told.flat is not None
    if y_m is not None:
        assert told.solved is not None
        assert np.array_equal(told.solved.eyes_m, aside(y_m))
        assert told.solved.revision == told.revision


def test_the_picture_goes_over_to_the_flat_one_evenly_and_back() -> None:
    flatness = Flatness(0.0)
    values = [flatness.toward(1.0, now_ns=k * 60 * NS_PER_MS) for k in range(8)]
    assert values == pytest.approx([0.0, 0.2, 0.4, 0.6, 0.8, 1.0, 1.0, 1.0])
    assert flatness.toward(0.0, now_ns=570 * NS_PER_MS) == pytest.approx(0.5)


@given(st.lists(st.tuples(st.sampled_from([0.0, 1.0]), st.integers(0, 500 * NS_PER_MS)), max_size=30))
def test_it_never_leaves_its_range_nor_passes_where_it_goes(story: list[tuple[float, int]]) -> None:
    flatness, now_ns = Flatness(), 0
    for target, passed_ns in story:
        now_ns += passed_ns
        before = flatness.value
        value = flatness.toward(target, now_ns=now_ns)
        assert 0.0 <= value <= 1.0
        assert abs(value - target) <= abs(before - target)


@pytest.mark.parametrize(
    ("done", "offered", "kind"),
    [
        (Effort(1, 4), Effort(1, 4), "nothing"),
        (Effort(1, 4), Effort(1, 3), "nothing"),
        (Effort(1, 4), Effort(1, 5), "refine"),
        (Effort(1, 4), Effort(1, 5, continued_from=4), "refine"),
        (Effort(2, 4), Effort(1, 0), "refine"),
        (Effort(1, 4), Effort(1, 4, focus=True), "refine"),
        (Effort(1, 4, focus=True), Effort(1, 8, continued_from=4), "nothing"),
        (Effort(2, 4), Effort(3, 9), "nothing"),
        (Effort(2, 4), Effort(1, 5, continued_from=4), "nothing"),  # was chosen for a solution on another raster
        (Effort(1, 4), None, "nothing"),
        (None, Effort(1, 4), "nothing"),
    ],
)
def test_only_more_effort_refines_a_solution(done: Effort | None, offered: Effort | None, kind: str) -> None:
    policy, key = FramePolicy(), SolutionKey(0, 0, EYES, done)
    request = replace(wish(), eyes_label="rested", refined_to=offered)
    flat = SolutionKey(0, 0, None)
    assert policy.next_job(request, plan=STILL, state_version=0, revision=0, solved=key, flat=flat).kind == kind
