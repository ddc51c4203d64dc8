"""Collect a run's statistics in bounded memory.

All times are measured on the run's clock, except `overhead_ms`, which is measured on the machine's clock.
"""

from __future__ import annotations

from collections import deque
from itertools import takewhile
from typing import Any

import numpy as np

from runtime.clock import NS_PER_MS, NS_PER_S
from runtime.evaluation.refresh_quality import view_error_mm
from runtime.records import SHOWN_STAGES, STAGES, RefreshAccount, State

WINDOW = 8192  # maximum number of values kept for each set of quantiles
NOW_NS = NS_PER_S  # length of the window used to measure current rates
NOW_KEPT = 1024  # maximum number of refreshes kept for this window
OVERHEAD_STAGES = ("sensor", "track")


class Quantiles:
    """Estimates the quantiles of a stream of values in bounded memory. Stores at most `size` values. When
    the store is full, every second value is dropped and the sampling interval is doubled. The maximum is exact.
    """

    def __init__(self, size: int = WINDOW) -> None:
        self._values = np.zeros(size)
        self._count, self._every, self._largest = 0, 1, -np.inf

    def add(self, value: float) -> None:
        self._largest = max(self._largest, value)
        if self._count % self._every == 0:
            place = self._count // self._every
            if place == self._values.size:
                place //= 2
                self._values[:place] = self._values[::2]
                self._every *= 2
            self._values[place] = value
        self._count += 1

    def of(self, *names: str) -> dict[str, float] | None:
        """Return the quantiles named (`p50`, `p95`, `p99`, `max`, ...), or None if no value has been added."""
        values = self._values[: -(-self._count // self._every)]
        if values.size == 0:
            return None
        quantiles = {name: float(np.quantile(values, float(name[1:]) / 100)) for name in names if name != "max"}
        return {name: round(quantiles.get(name, self._largest), 4) for name in names}


class RunStats:
    """Counts a run's refreshes and faults, and collects quantiles of its times."""

    def __init__(self) -> None:
        self.frames = self.presented = self.dropped = self.solutions = self.missed_blanks = 0
        self.faults: dict[str, int] = {}
        self._first_ns = self._last_ns = -1
        self._last_presented_ns = -1
        self._stages = {stage: Quantiles() for stage in STAGES if stage != "step"}  # steps count as `finish`
        self._interval, self._photon, self._overhead = Quantiles(), Quantiles(), Quantiles()
        self._overhead_run, self._skew, self._age, self._sigma = Quantiles(), Quantiles(), Quantiles(), Quantiles()
        self._view_error = Quantiles()
        self._efforts_ns: dict[str, int] = {}
        self._effort: str | None = None  # effort of the solution shown at the latest refresh
        self._recent: deque[tuple[int, bool, bool]] = deque(maxlen=NOW_KEPT)  # time, presented, shows new solution

    def add(self, account: RefreshAccount, *, overhead_ms: float, missed_blanks: int = 0) -> None:
        """Count a refresh. Overhead is on the machine's clock, without presenting and waiting.
        `missed_blanks` counts from the start of the run.
        """
        now_ns, ran = account.present_ns, account.inference == "ran"
        self._first_ns = now_ns if self._first_ns < 0 else self._first_ns
        if self._effort is not None:
            self._efforts_ns[self._effort] = self._efforts_ns.get(self._effort, 0) + now_ns - self._last_ns
        self._last_ns, self._effort = now_ns, account.effort
        self.frames += 1
        self.presented += account.presented
        self.dropped += not account.presented
        self.solutions += ran
        self.missed_blanks = missed_blanks
        self._recent.append((now_ns, account.presented, ran))
        for stage, spent_ms in account.stage_ms.items():
            self._stages[stage].add(spent_ms)
        if self.frames > 1:  # the first refresh allocates buffers
            self._overhead.add(overhead_ms)
            self._overhead_run.add(sum(account.stage_ms.get(stage, 0.0) for stage in OVERHEAD_STAGES))
        if not account.presented:
            self._last_presented_ns = -1
            return
        if self._last_presented_ns >= 0:
            self._interval.add((now_ns - self._last_presented_ns) / NS_PER_MS)
        self._last_presented_ns = now_ns
        self._skew.add(account.skew_ms)
        if account.capture_ns and account.state is State.TRACKING:
            self._photon.add((account.photon_ns - account.capture_ns) / NS_PER_MS)
        if account.solution_age_ms is not None:
            self._age.add(account.solution_age_ms)
        if account.eye_sigma_mm is not None:
            self._sigma.add(account.eye_sigma_mm)
        if account.eyes_m is not None and account.solved_for_m is not None:
            self._view_error.add(view_error_mm(account.eyes_m, account.solved_for_m))

    def seconds(self) -> float:
        """Return the time from the first refresh to the latest, in seconds."""
        return (self._last_ns - self._first_ns) / NS_PER_S if self.frames else 0.0

    def reuse_saves_ms(self) -> float | None:
        """Return the solver time saved by reusing a solution, in ms, or None if none has been reused."""
        medians = [self._stages[stage].of("p50") for stage in SHOWN_STAGES]
        known = [median["p50"] for median in medians if median is not None]
        return sum(known) if known and self.presented > self.solutions > 0 else None

    def rates_now(self) -> dict[str, float | None]:
        """Return the refreshes and solutions per second over the last second, or None below two refreshes."""
        newest_first = reversed(tuple(self._recent))
        recent = [*takewhile(lambda entry: entry[0] > self._last_ns - NOW_NS, newest_first)][::-1]
        if len(recent) < 2:
            return {"fps_now": None, "solutions_per_s_now": None}
        span_s = max((recent[-1][0] - recent[0][0]) / NS_PER_S, 1e-9)
        return {
            "fps_now": round(sum(presented for _, presented, _ in recent[1:]) / span_s, 2),
            "solutions_per_s_now": round(sum(ran for _, _, ran in recent[1:]) / span_s, 2),
        }

    def fault(self, part: str) -> None:
        """Count a part's fault when it begins. Its reason may change before the part works again."""
        self.faults[part] = self.faults.get(part, 0) + 1

    def summary(self, *, stale_inputs: int, simulated: bool = False) -> dict[str, Any]:
        """Return the counts and times for summary.json (docs/contracts.md), null if not measured.
        `stale_inputs` are samples superseded before use. On a simulated clock, the overhead follows from the
        configuration.
        """
        seconds = self.seconds()
        return {
            "frames": self.frames,
            "presented": self.presented,
            "dropped": self.dropped,
            "stale_inputs": stale_inputs,
            "inferences": self.solutions,
            "seconds": round(seconds, 3),
            "fps": round(max(self.presented - 1, 0) / seconds, 2) if seconds > 0 else None,
            "solutions_per_s": round(self.solutions / seconds, 2) if seconds > 0 else None,
            "stage_ms": {stage: ring.of("p50", "p95", "p99", "max") for stage, ring in self._stages.items()},
            "interval_ms": self._interval.of("p50", "p99"),
            "photon_ms": self._photon.of("p50", "p99"),
            "overhead_ms": (self._overhead_run if simulated else self._overhead).of("p50", "p99"),
            "skew_ms": self._skew.of("p50", "p99", "max"),
            "solution_age_ms": self._age.of("p50", "p99"),
            "eye_sigma_mm": self._sigma.of("p50", "p99"),
            "view_error_estimated_mm": self._view_error.of("p50", "p95"),
            "efforts": {name: round(ns / NS_PER_S, 3) for name, ns in sorted(self._efforts_ns.items())} or None,
            "missed_blanks": self.missed_blanks,
            "faults": dict(self.faults),
        }
