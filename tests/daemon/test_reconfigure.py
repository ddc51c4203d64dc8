"""Tests that a change of settings is adopted as a whole between two steps, or refused without effect."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
import pytest

from runtime.config import Settings
from runtime.daemon import reconfigure
from runtime.daemon.reconfigure import Reconfiguration, ready_predictor
from runtime.daemon.solver_parts import RunningSolver, SolverSetup
from runtime.errors import ContentFailure
from runtime.frame.solver import SceneState
from runtime.model.base import warm_up
from runtime.records import SolveRequest
from runtime.support.gl import offscreen_context
from tests.daemon.rig import SMALL
from tests.waiting import eventually

EYES = np.array([[0.7, -0.031, 0.0], [0.7, 0.031, 0.0]])
PATIENCE_S = 30.0


def settings(**changes: dict[str, Any]) -> Settings:
    tables = {**{name: SMALL[name] for name in ("stack", "model")}, "content": {"scene": "demo"}}
    return Settings.model_validate({n: {**tables.get(n, {}), **changes.get(n, {})} for n in {**tables, **changes}})


class Lent:
    """Content or a model that remembers whether it was closed."""

    def __init__(self, whole: Any) -> None:
        self._whole, self.closed = whole, 0

    def close(self) -> None:
        self.closed += 1
        self._whole.close()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._whole, name)


class Bench:
    """A solver's parts on this thread, and everything that is loaded for them."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.gate = threading.Event()  # set: models come to be ready
        self.gate.set()
        self.models: list[Lent] = []
        self.contents: list[Lent] = []
        prepare = reconfigure.prepare_content

        def ready(chosen: Settings, stack: Any, **how: Any) -> Any:
            made = Lent(ready_predictor(chosen, stack, **how))
            self.models.append(made)
            assert self.gate.wait(PATIENCE_S)
            return made

        def prepared(chosen: Any, stack: Any, **how: Any) -> Any:
            opener = prepare(chosen, stack, **how)

            def make(context: Any) -> Any:
                self.contents.append(Lent(opener(context=context)))
                return self.contents[-1]

            return make

        monkeypatch.setattr(reconfigure, "ready_predictor", ready)
        monkeypatch.setattr(reconfigure, "prepare_content", prepared)
        self.settings = settings()
        self.stack = self.settings.stack.stack()
        self.context = offscreen_context()
        self.parts = RunningSolver(SolverSetup(self.settings, self.stack, simulated=True), context=self.context)
        state = self.parts.solver.state
        self.first_content, self.first_model = Lent(state.content), Lent(state.predictor)
        self.parts.solver.replace(content=self.first_content, predictor=self.first_model)

    @property
    def state(self) -> SceneState:
        return self.parts.solver.state

    def change(self, new: Settings, **how: Any) -> Reconfiguration:
        return Reconfiguration(new, self.state.settings, self.stack, **how)

    def advance(self, change: Reconfiguration) -> None:
        """Until it is over."""
        parts = self.parts
        adopts = partial(change.advance, parts.solver, parts.context, parts.backend.backend)
        assert eventually(adopts, within_s=PATIENCE_S)

    def solve(self) -> Any:
        """Run two steps without a fault: a missing flat picture, and a changed solution."""
        request = SolveRequest(0, EYES, "predicted", 0.001, flat_wanted=False)
        steps = [self.parts.step(request), self.parts.step(request)]
        assert not any(step.missing for step in steps)
        return next((step.solution for step in steps if step.solution is not None), None)

    def close(self) -> None:
        self.gate.set()
        self.parts.close()
        self.context.release()


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    made = Bench(monkeypatch)
    yield made
    made.close()


SCENE, MODEL = {"content": {"scene": "sparse"}}, {"model": {"name": "balanced"}}


def test_what_was_loaded_is_closed_where_it_can_t_be_taken_over(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(*_: Any, **__: Any) -> Any:
        raise RuntimeError("out of textures")

    before = bench.state
    monkeypatch.setattr(reconfigure, "prepare_content", lambda *_, **__: failing)
    change = bench.change(settings(**SCENE, **MODEL))
    bench.advance(change)
    assert change.problem and bench.state is before
    assert [made.closed for made in (*bench.models, *bench.contents)] == [1] * (1 + len(bench.contents))
    assert (bench.first_content.closed, bench.first_model.closed) == (0, 0)
    bench.solve()


def test_what_is_no_longer_wanted_is_closed_and_changes_nothing(bench: Bench) -> None:
    before = bench.state
    bench.gate.clear()
    change = bench.change(settings(**SCENE, **MODEL))
    assert eventually(lambda: bool(bench.models), within_s=PATIENCE_S)
    change.abandon()
    bench.gate.set()
    bench.advance(change)
    assert bench.state is before
    assert [model.closed for model in bench.models] == [1] and not bench.contents
    assert (bench.first_content.closed, bench.first_model.closed) == (0, 0)
    bench.solve()


def test_what_is_decided_anew_for_every_solution_loads_no_model(bench: Bench) -> None:
    before = bench.state
    change = bench.change(settings(model={"eye_sigma_mm": 2.0}))
    bench.advance(change)
    assert bench.state.predictor is before.predictor
    assert bench.models == []


def test_costs_are_calibrated_with_the_scene_once_for_each_model(bench: Bench) -> None:
    first = bench.parts.first_costs(time_ns=0)
    assert set(first) == set(bench.state.predictor.facts.reductions)
    assert all(stages["render"] > 0 and stages["finish"] > 0 for stages in first.values())
    assert bench.parts.first_costs(time_ns=0) is first
    bench.advance(bench.change(settings(**MODEL)))
    after = bench.parts.first_costs(time_ns=0)
    assert after is not first and set(after) == set(bench.state.predictor.facts.reductions)


def test_a_stack_that_reaches_past_the_usual_eyes_is_warmed_up() -> None:
    """With assumed eyes between its panels, the process ended."""
    large = settings(stack={"x_m": (-1.0, 0.0, 1.0)})
    predictor = ready_predictor(large, large.stack.stack())
    assert all(stages["step"] > 0 for stages in warm_up(predictor).values())
    predictor.close()


def test_content_that_cannot_be_drawn_yet_leaves_the_costs_of_warm_up(bench: Bench) -> None:
    def missing(*_: Any, **__: Any) -> Any:
        raise ContentFailure("no program is connected")

    bench.first_content.draw = missing  # type: ignore[attr-defined]
    costs = bench.parts.first_costs(time_ns=0)
    assert set(costs) == set(bench.state.predictor.facts.reductions)
    assert all("render" not in stages and stages["step"] > 0 for stages in costs.values())
    del bench.first_content.draw  # type: ignore[attr-defined]
    assert bench.solve() is not None
