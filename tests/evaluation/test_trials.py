"""The one timer: what it counts, and in which order it calls."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from runtime.evaluation import trials
from runtime.evaluation.trials import Timed, timed, timed_in_turn


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """A clock that only moves when a call moves it, nanoseconds."""
    now = [0]
    monkeypatch.setattr(trials, "perf_counter_ns", lambda: now[0])
    return now


def test_warm_ups_do_not_count(clock: list[int]) -> None:
    costs_ms = iter([100, 50, 1, 2, 3])

    def call() -> str:
        clock[0] += next(costs_ms) * 10**6
        return "answer"

    done = timed(call, runs=3, warm_up=2)
    assert done.times_ms == (1, 2, 3)
    assert done.answer == "answer"
    assert next(costs_ms, None) is None


def test_it_goes_on_until_it_is_enough_or_has_been_often_enough(clock: list[int]) -> None:
    def call() -> None:
        clock[0] += 10 * 10**6

    assert len(timed(call, runs=3, most=25, enough_s=0.1).times_ms) == 10
    assert len(timed(call, runs=3, most=5, enough_s=0.1).times_ms) == 5
    assert len(timed(call, runs=3, most=25, enough_s=0.01).times_ms) == 3


def test_a_call_that_is_slow_is_called_once(clock: list[int]) -> None:
    calls = []

    def call() -> None:
        calls.append(1)
        clock[0] += 5 * 10**9

    assert timed(call, runs=3, slow_s=4.0).times_ms == (5000,)
    assert len(calls) == 1


def test_several_ways_take_turns_and_the_last_answers_are_kept_beside_the_time(clock: list[int]) -> None:
    order = []
    shared = np.zeros(1)

    def way(name: str, cost_ms: int) -> Any:
        def call(run: int) -> np.ndarray:
            order.append((name, run))
            clock[0] += cost_ms * 10**6
            shared[0] = run + cost_ms
            return shared

        return call

    def keep(answer: np.ndarray) -> np.ndarray:
        clock[0] += 10**9
        return answer.copy()

    done = timed_in_turn({"a": way("a", 1), "b": way("b", 7)}, runs=2, keep=keep)
    assert order == [("a", 0), ("b", 0), ("a", 1), ("b", 1), ("a", 2), ("b", 2)]
    assert done["a"].times_ms == (1, 1)
    assert done["b"].times_ms == (7, 7)
    assert (done["a"].answer[0], done["b"].answer[0]) == (3, 9)


def test_the_median_is_of_the_counted_runs() -> None:
    assert Timed(None, tuple(float(n) for n in range(101))).median_ms == 50
