"""What a run came to: bounded memory however long it lasts."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from time import perf_counter
from typing import Any

import numpy as np

from runtime.records import FrameAccount

STAGES = ("sensor", "track", "render", "prepare", "inference", "finish", "present", "wait")
NOT_OVERHEAD = ("render", "prepare", "inference", "finish", "present", "wait")
SOLVING = ("render", "prepare", "inference", "finish")  # what a frame that is presented again does without
WINDOW = 8192  # turns that quantiles are taken over


class Ring:
    """The newest values, for quantiles."""

    def __init__(self, size: int = WINDOW) -> None:
        self._values = np.zeros(size)
        self._count = 0

    def add(self, value: float) -> None:
        self._values[self._count % self._values.size] = value
        self._count += 1

    def quantiles(self, names: Iterable[str]) -> dict[str, float]:
        """`p50`, `p95`, `p99`, `max`, ... of what is held; empty before the first value."""
        held = self._values[: min(self._count, self._values.size)]
        if held.size == 0:
            return {}
        return {
            name: round(float(held.max() if name == "max" else np.percentile(held, float(name[1:]))), 4)
            for name in names
        }


class RunStats:
    """Counters and quantiles of a run, fed one FrameAccount a turn."""

    def __init__(self) -> None:
        self.frames = self.presented = self.dropped = self.inferences = 0
        self.missed_vblanks = 0
        self.faults: dict[str, int] = {}
        self._times_s: deque[float] = deque(maxlen=60)
        self._stages = {stage: Ring() for stage in STAGES}
        self._solving = {"ran": Ring(), "reused": Ring()}
        self._overhead, self._skew, self._latency = Ring(), Ring(), Ring()

    def add(self, account: FrameAccount, *, turn_ms: float) -> None:
        """One turn; `turn_ms` is its whole duration on the machine's clock, evaluation left out."""
        self.frames += 1
        self.presented += account.presented
        if account.presented:
            self._times_s.append(perf_counter())
        self.dropped += not account.presented
        self.inferences += account.inference == "ran"
        for stage, ring in self._stages.items():
            ring.add(account.measured_ms.get(stage, 0.0))
        if account.inference in self._solving and self.frames > 1:
            self._solving[account.inference].add(sum(account.measured_ms.get(stage, 0.0) for stage in SOLVING))
        if self.frames > 1:  # the first turn pays for what is allocated once
            spent = sum(account.measured_ms.get(stage, 0.0) for stage in NOT_OVERHEAD)
            self._overhead.add(max(0.0, turn_ms - spent))
        if account.presented:
            self._skew.add(account.skew_ms)
            if account.capture_ns:
                self._latency.add((account.present_ns - account.capture_ns) / 1e6)

    def reuse_saves_ms(self) -> float | None:
        """Median of a frame that was solved less that of one presented again; None before there are both."""
        medians = [ring.quantiles(("p50",)).get("p50") for ring in self._solving.values()]
        ran, reused = medians
        return None if ran is None or reused is None else ran - reused

    def recent_fps(self) -> float:
        """Presented frames a second over the last turns."""
        if len(self._times_s) < 2:
            return 0.0
        return (len(self._times_s) - 1) / max(self._times_s[-1] - self._times_s[0], 1e-9)

    def fault(self, part: str) -> None:
        """A fault that the run lives on with."""
        self.faults[part] = self.faults.get(part, 0) + 1

    def summary(self, *, seconds: float, stale_inputs: int) -> dict[str, Any]:
        """The part of summary.json that is counted (design 5.2)."""
        return {
            "frames": self.frames,
            "presented": self.presented,
            "dropped": self.dropped,
            "stale_inputs": stale_inputs,
            "inferences": self.inferences,
            "seconds": round(seconds, 3),
            "fps": round(self.presented / seconds, 2) if seconds > 0 else 0.0,
            "stage_ms": {stage: ring.quantiles(("p50", "p95", "p99", "max")) for stage, ring in self._stages.items()},
            "overhead_ms": self._overhead.quantiles(("p50", "p99")),
            "skew_ms": self._skew.quantiles(("p50", "p99", "max")),
            "latency_ms": self._latency.quantiles(("p50", "p95", "p99")),
            "missed_vblanks": self.missed_vblanks,
            "faults": dict(self.faults),
        }
