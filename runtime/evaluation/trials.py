"""The one timer of trials: warm up, repeat, take turns; median and p99."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from time import perf_counter_ns
from typing import Generic, TypeVar

import numpy as np

from runtime.clock import NS_PER_MS

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
    warm_up: int = 1,
) -> Timed[T]:
    """`warm_up` runs that don't count, then at least `runs`; then more until they add up to `enough_s` or are `most`.

    slow_s: where the first warm-up takes longer, it counts and is the only run.
    """
    for run in range(warm_up):
        answer, took_ms = _timed(call)
        if run == 0 and took_ms >= slow_s * 1e3:
            return Timed(answer, (took_ms,))
    times_ms: list[float] = []
    while len(times_ms) < runs or (sum(times_ms) < enough_s * 1e3 and len(times_ms) < (most or runs)):
        answer, took_ms = _timed(call)
        times_ms.append(took_ms)
    return Timed(answer, tuple(times_ms))


def timed_in_turn(
    ways: Mapping[str, Callable[[int], T]],
    *,
    runs: int,
    warm_up: int = 1,
    keep: Callable[[T], T] = lambda answer: answer,
) -> dict[str, Timed[T]]:
    """Several calls that take turns, run by run: what slows the machine slows all of them.

    Each is told the number of its run, warm-ups included. keep: makes the last answer one's own, beside the time.
    """
    times: dict[str, list[float]] = {name: [] for name in ways}
    answers: dict[str, T] = {}
    for run in range(warm_up + runs):
        for name, way in ways.items():
            begin_ns = perf_counter_ns()
            answer = way(run)
            took_ms = (perf_counter_ns() - begin_ns) / NS_PER_MS
            if run >= warm_up:
                times[name].append(took_ms)
            if run == warm_up + runs - 1:
                answers[name] = keep(answer)
    return {name: Timed(answers[name], tuple(times[name])) for name in ways}


def _timed(call: Callable[[], T]) -> tuple[T, float]:
    begin_ns = perf_counter_ns()
    answer = call()
    return answer, (perf_counter_ns() - begin_ns) / NS_PER_MS
