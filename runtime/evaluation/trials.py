"""The one timer of trials: warm up, repeat, take turns; median and p99."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from time import perf_counter_ns
from typing import Generic, TypeVar

import numpy as np

from runtime.clock import NS_PER_MS
from runtime.records import U8

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Timed(Generic[T]):
    """What a call took, run by run, and the last run's answer."""

    answer: T
    times_ms: tuple[float, ...]

    @property
    def median_ms(self) -> float:
        return float(np.median(self.times_ms))


def timed(
    call: Callable[[], T],
    *,
    runs: int,
    most: int | None = None,
    enough_s: float = 0.0,
    slow_s: float = float("inf"),
) -> Timed[T]:
    """Time a warm function: `runs` at least, then more up to `enough_s` or `most` runs.

    slow_s: where the first takes longer, it counts and is the only run.
    """
    answer, took_ms = _timed(call)
    if took_ms >= slow_s * 1e3:
        return Timed(answer, (took_ms,))
    times_ms: list[float] = []
    while len(times_ms) < runs or (sum(times_ms) < enough_s * 1e3 and len(times_ms) < (most or runs)):
        answer, took_ms = _timed(call)
        times_ms.append(took_ms)
    return Timed(answer, tuple(times_ms))


def timed_in_turn(ways: Mapping[str, Callable[[], U8]], *, runs: int) -> dict[str, Timed[U8]]:
    """Several calls that take turns, run by run: what slows the machine slows all of them.

    The first run of each doesn't count. Answers are copies: a call may use its own again.
    """
    times: dict[str, list[float]] = {name: [] for name in ways}
    answers: dict[str, U8] = {}
    for run in range(1 + runs):
        for name, way in ways.items():
            answer, took_ms = _timed(way)
            times[name] += [took_ms] if run > 0 else []
            if run == runs:
                answers[name] = answer.copy()
    return {name: Timed(answers[name], tuple(times[name])) for name in ways}


def _timed(call: Callable[[], T]) -> tuple[T, float]:
    begin_ns = perf_counter_ns()
    answer = call()
    return answer, (perf_counter_ns() - begin_ns) / NS_PER_MS
