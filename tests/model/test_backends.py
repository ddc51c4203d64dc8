"""The faster backend, on a clock that the solutions advance."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from runtime.clock import SimulatedClock
from runtime.model import backends
from runtime.model.backends import choose
from runtime.model.base import ModelFacts
from runtime.model.gl import state
from runtime.model.job import Job
from runtime.optics.stack import PanelStack


class Gl:
    name = "gl"
    closed = False

    def __init__(self, context: object, stack: PanelStack) -> None:
        self.context = context

    def close(self) -> None:
        type(self).closed = True


class Timed:
    """A model whose solutions take the times of their backend and raster, one after the other."""

    facts = ModelFacts("timed", "numpy", has_devices=True)

    def __init__(self, clock: SimulatedClock, stack: PanelStack, times_ms: dict[str, list[float]]) -> None:
        self.clock, self.stack, self.times_ms, self.closed = clock, stack, times_ms, 0

    def bound(self, *, stack: PanelStack, backend: Any) -> Timed:
        self.used = f"{backend.name} {stack.width_px}x{stack.height_px}"
        return self

    def solve(self, job: Job) -> None:
        assert job.eye_sigma_m == 0.0
        left, right = (view.pixels for view in job.views)
        assert left.std() > 50 and (left[..., :3] != right[..., :3]).any() and (left[..., 3] == 255).all()
        times = self.times_ms[self.used]
        self.clock.sleep_until_ns(self.clock.now_ns() + int((times.pop(0) if len(times) > 1 else times[0]) * 1e6))

    def close(self) -> None:
        self.closed += 1


WIDE = (480, 320)
CLOSE = {"cpu 120x80": [25], "gl 120x80": [10]}
EQUAL = ("cpu 64x75", "gl 64x75", "cpu 128x300", "gl 128x300")


@pytest.mark.parametrize(
    ("size", "times_ms", "name", "why"),
    [
        (WIDE, {"cpu 120x80": [90, 11, 10, 12], "gl 120x80": [26]}, "cpu", "120x80: cpu 10.0 ms, gl 26.0 ms"),
        (WIDE, {"cpu 120x80": [26], "gl 120x80": [10]}, "gl", "120x80: cpu 26.0 ms, gl 10.0 ms"),
        (WIDE, CLOSE | {"cpu 480x320": [99, 20], "gl 480x320": [99, 30]}, "cpu", "480x320: cpu 20.0 ms, gl 30.0 ms"),
        (WIDE, CLOSE | {"cpu 480x320": [99, 90, 1], "gl 480x320": [8]}, "gl", "480x320: cpu 90.0 ms, gl 8.0 ms"),
        ((128, 300), {key: [10.0] for key in EQUAL}, "cpu", "128x300: cpu 10.0 ms, gl 10.0 ms"),
    ],
)
def test_the_second_comparison_decides_unless_the_first_is_clear(
    size: tuple[int, int], times_ms: dict[str, list[float]], name: str, why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = SimulatedClock()
    monkeypatch.setattr(backends, "perf_counter_ns", clock.now_ns)
    monkeypatch.setattr(state, "GlBackend", Gl)
    monkeypatch.setattr(Gl, "closed", False)
    model: Any = Timed(clock, PanelStack(0.4, 0.25, (-0.02, 0.0, 0.02), *size), times_ms)
    choice = choose("auto", model, object)
    assert (choice.backend.name, choice.why) == (name, f"the faster at {why}")
    assert Gl.closed == (name == "cpu") and model.closed == len(times_ms)
    for configured in ("cpu", "gl"):
        choice = choose(configured, model, object)  # type: ignore[arg-type]
        assert (choice.backend.name, choice.why) == (configured, "as configured")
    model.facts = replace(model.facts, has_devices=False)
    assert choose("gl", model, object).why == "the only backend that supports timed"
