"""Tests number and order of the calls that the timer makes."""

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


def test_several_ways_take_turns_and_the_last_answers_are_copies(clock: list[int]) -> None:
    order = []
    shared = np.zeros(1, np.uint8)

    def way(name: str, cost_ms: int) -> Any:
        def call() -> np.ndarray:
            order.append(name)
            clock[0] += cost_ms * 10**6
            shared[0] += cost_ms
            return shared

        return call

    done = timed_in_turn({"a": way("a", 1), "b": way("b", 7)}, runs=2)
    assert order == ["a", "b"] * 3
    assert done["a"].times_ms == (1, 1)
    assert done["b"].times_ms == (7, 7)
    assert (done["a"].answer[0], done["b"].answer[0]) == (17, 24)
