"""Time calls over repeated runs, after a warm-up. Several calls can be timed in alternation."""

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
    """The times of a call's runs, and the last run's result."""

    answer: T
    times_ms: tuple[float, ...]  # in the order of the runs, without the warm-up

    @property
    def median_ms(self) -> float:
        return float(np.median(self.times_ms))


def timed(
    call: Callable[[], T], *, runs: int, most: int | None = None, enough_s: float = 0.0, slow_s: float = float("inf")
) -> Timed[T]:
    """Time repeated runs of a call, after a warm-up, which counts and is the only run if it takes
    `slow_s`. After `enough_s` of timed runs, no other is started.
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
    """Time calls by name in alternation, so that other load on the machine affects all of them alike.
    Their last results are copied, because a call may reuse the buffer it returns.
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
