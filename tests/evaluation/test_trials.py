"""The one timer: what it counts, and in which order it calls."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from runtime.evaluation import trials
from runtime.evaluation.trials import timed, timed_in_turn


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """A clock that only moves when a call moves it, nanoseconds."""
    now = [0]
    monkeypatch.setattr(trials, "perf_counter_ns", lambda: now[0])
    return now


def test_the_first_run_does_not_count(clock: list[int]) -> None:
    costs_ms = iter([100, 1, 2, 3])

    def call() -> str:
        clock[0] += next(costs_ms) * 10**6
        return "answer"

    done = timed(call, runs=3)
    assert done.times_ms == (1, 2, 3)
    assert done.answer == "answer"
    assert next(costs_ms, None) is None


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
