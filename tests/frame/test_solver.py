"""Tests solutions of real content and a real model, and that failures leave earlier results valid."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from runtime.clock import NS_PER_S
from runtime.config import ContentSettings, Settings, changed
from runtime.content import shapes
from runtime.content.base import ContentInfo, ContentSource, View
from runtime.content.procedural import ProceduralSource
from runtime.content.registry import open_content
from runtime.content.scenes import Scene, Thing
from runtime.errors import ContentFailure, ModelFailure
from runtime.frame import solver as solver_module
from runtime.frame.solver import SceneState, Solver, SolverUpdate
from runtime.model.predictor import Predictor
from runtime.plan.drawing import drawn_job
from runtime.records import U8, Effort, SolveRequest
from tests.frame.conftest import SMALL
from tests.frame.fakes import EYES, aside


def wish(eyes_m: Any = EYES, *, time_ns: int = 0, sigma_m: float = 0.001, flat: bool = False) -> SolveRequest:
    return SolveRequest(time_ns, eyes_m, "predicted" if eyes_m is not None else "none", sigma_m, flat_wanted=flat)


@pytest.fixture
def state(content: ContentSource, predictor: Predictor) -> SceneState:
    settings = Settings.model_validate({"model": {"name": "fast", "threads": 1}})
    return SceneState(0, 1, settings, content, predictor)


@pytest.fixture
def solver(state: SceneState) -> Solver:
    """With its flat picture drawn."""
    made = Solver(state, SMALL)
    assert made.step(wish(None, flat=True)).flat is not None
    return made


def test_the_flat_picture_is_for_eyes_anywhere_and_equal_along_every_ray(state: SceneState) -> None:
    flat = Solver(state, SMALL).step(wish(None, flat=True)).flat
    assert flat.solved_for_m is None
    assert flat.layers.shape == (3, 108, 192, 4)
    assert set(flat.stage_ms) == {"render"}


def test_a_solution_is_the_model_s_answer_to_the_content_s_pictures(solver: Solver, state: SceneState) -> None:
    solution = solver.step(wish(time_ns=77)).solution
    job = drawn_job(state.predictor, state.content, EYES, time_ns=77, trimmed=True)
    layers = state.predictor.solve(replace(job, eye_sigma_m=solution.eye_sigma_m)).layers
    assert np.array_equal(solution.layers, layers)
    assert np.array_equal(solution.solved_for_m, EYES)
    assert solution.solved_for_ns == 77
    assert solution.seeing == (True, True)
    assert solution.layers.std() > 5
    stages = {"render", "prepare", "inference", "finish", "step"}
    assert set(solution.stage_ms) == set(solver.trial_ms(EYES, 2, time_ns=0)) == stages
    assert solution.stage_ms["render"] > 0 and solver.step(wish(aside(0.1))).solution.number == solution.number + 1


def test_another_solver_of_the_run_gives_no_number_a_second_time(solver: Solver) -> None:
    """Sinks know layers by their number: the same one for other layers would leave the old ones on the panels."""
    numbers = [solver.step(wish(aside(k / 100))).solution.number for k in range(3)]
    another = Solver(solver.state, SMALL, first_number=max(numbers) + 1)
    first = [another.step(wish(None, flat=True)).flat.number, another.step(wish()).solution.number]
    assert first == [numbers[-1] + 1, numbers[-1] + 2]


def test_a_solution_that_is_held_never_changes_whatever_is_solved_after_it(solver: Solver) -> None:
    held = [solver.step(wish(aside(k / 50))).solution for k in range(3)]
    copies = [solution.layers.copy() for solution in held]
    for k in range(3, 8):
        solver.step(wish(aside(k / 50)))
    for solution, copy in zip(held, copies, strict=True):
        assert np.array_equal(solution.layers, copy)
    assert not np.array_equal(copies[0], copies[2])


def test_the_same_eyes_and_content_are_not_solved_for_twice(solver: Solver) -> None:
    assert solver.step(wish()).solution is not None
    assert solver.step(wish(time_ns=NS_PER_S)) == SolverUpdate()
    assert solver.step(wish(aside(0.001))).solution is not None


def test_another_state_is_solved_for_with_its_own_parts(solver: Solver, shared_context: Any) -> None:
    first = solver.step(wish()).solution
    other = open_content(ContentSettings(scene="texture"), SMALL, shared_context)
    solver.replace(content=other)
    second = solver.step(wish()).solution
    assert not np.array_equal(first.layers, second.layers)
    assert solver.step(wish()) == SolverUpdate()
    solver.replace(settings=changed(solver.state.settings, "model", {"threads": 2}, source="a test"))
    assert (solver.state.version, solver.state.scene) == (2, 2), "the content has changed once"
    other.close()


def test_content_that_moves_is_solved_for_at_its_instant(solver: Solver, shared_context: Any) -> None:
    moving = open_content(ContentSettings(scene="moving"), SMALL, shared_context)
    solver.replace(content=moving)
    layers = [solver.step(wish(time_ns=t)).solution.layers for t in (0, NS_PER_S // 3)]
    assert not np.array_equal(layers[0], layers[1])
    moving.close()


def test_less_certain_eyes_get_a_more_tolerant_solution(solver: Solver) -> None:
    sigmas = [solver.step(wish(aside(k / 100), sigma_m=k / 1000)).solution.eye_sigma_m for k in range(4)]
    assert sigmas == pytest.approx([0.0, 0.001, 0.002, 0.003]), "the tracker's alone"
    solver.replace(settings=changed(solver.state.settings, "model", {"eye_sigma_mm": 2.5}, source="a test"))
    assert solver.step(wish()).solution.eye_sigma_m == pytest.approx(0.0025)


def test_after_its_budget_no_further_step_begins_but_on_a_simulated_clock(solver: Solver) -> None:
    whole = solver.step(wish()).solution.layers.copy()
    solver.replace(settings=changed(solver.state.settings, "model", {"budget_ms": 1e-3}, source="a test"))
    limited, simulated = (Solver(solver.state, SMALL, timed=timed) for timed in (True, False))
    for made in (limited, simulated):
        made.step(wish(None, flat=True))
    assert not np.array_equal(limited.step(wish()).solution.layers, whole)
    assert np.array_equal(simulated.step(wish()).solution.layers, whole)


def test_no_more_steps_are_made_than_the_model_has(solver: Solver, predictor: Predictor) -> None:
    """The presenter may not have seen yet that the model was replaced."""
    solution = solver.step(replace(wish(), effort=Effort(2, predictor.facts.steps + 6))).solution
    assert solution.effort == Effort(2, predictor.facts.steps)


def test_a_coarse_solution_is_not_continued_in_place_of_an_earlier_one(solver: Solver) -> None:
    """The presenter asks to continue the full solution that it shows, while a coarse one for newer eyes is made."""
    moved = aside(0.002)
    solver.step(replace(wish(), eyes_label="rested", effort=Effort(1, 1)))
    request = replace(wish(moved), eyes_label="rested", effort=Effort(2, 0))
    assert solver.step(replace(request, refined_to=Effort(1, 2, continued_from=1))).solution.effort == Effort(2, 0)
    assert solver.step(replace(request, refined_to=Effort(1, 2, continued_from=1))).solution is None
    refined = solver.step(replace(request, refined_to=Effort(1, 0))).solution
    continued = solver.step(replace(request, refined_to=Effort(1, 1, continued_from=0))).solution
    assert [refined.effort, continued.effort] == [Effort(1, 0), Effort(1, 1, continued_from=0)]
    assert refined.layers.shape == continued.layers.shape == (3, 108, 192, 4), "the display's own raster"


OFF_M = np.array([[0.123, 0.43, 0.0], [0.078, 0.47, 0.0]])  # the right eye is 80.6 degrees off the axis


def test_an_eye_beside_the_display_gets_the_other_s_picture(solver: Solver) -> None:
    solution = solver.step(wish(OFF_M)).solution
    assert solution.seeing == (True, False)
    assert np.array_equal(solution.solved_for_m, OFF_M[[0, 0]])
    assert "the right eye" in [item.what for item in solver.plan.items] and solver.seeing == (True, False)
    assert solver.step(wish()).solution.seeing == (True, True)


def test_the_flat_picture_is_drawn_from_the_middle_of_the_last_eyes(solver: Solver) -> None:
    solver.step(wish(aside(0.25)))
    aside_flat = solver.step(wish(None, flat=True)).flat.layers
    solver.step(wish(aside(-0.25)))
    assert not np.array_equal(solver.step(wish(None, flat=True)).flat.layers, aside_flat)


def test_one_solution_in_four_is_measured_and_the_next_compared_with_it(solver: Solver) -> None:
    step_m = np.array([0.0, 0.002, 0.0])
    measures = [solver.step(wish(EYES + n * step_m)).solution.measures for n in range(8)]
    assert [m.residual is not None for m in measures] == [True, False, False, False] * 2
    assert [m.change is not None for m in measures] == [False, True, False, False] * 2
    changed, moved_m, elapsed_s = measures[1].change
    assert changed > 0.0
    assert moved_m == pytest.approx(0.002)
    assert elapsed_s == 0.0


def broken(part: Any, name: str, fault: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*arguments: Any, **keywords: Any) -> Any:
        raise fault

    monkeypatch.setattr(part, name, fail)


@pytest.mark.parametrize("fault", [ContentFailure("no such frame"), ZeroDivisionError("in a mesh")])
@pytest.mark.parametrize("where", ["draw", "revision"])
def test_content_that_fails_is_named_with_its_reason_and_tried_again(
    solver: Solver, content: ContentSource, monkeypatch: pytest.MonkeyPatch, fault: Exception, where: str
) -> None:
    with monkeypatch.context() as patch:
        broken(content, where, fault, patch)
        step = solver.step(wish())
        assert step.solution is None
        assert step.missing == {"content": str(fault)}
        assert solver.step(wish()).missing == {"content": str(fault)}
    step = solver.step(wish())
    assert step.solution is not None
    assert step.missing == {}


@pytest.mark.parametrize("fault", [ModelFailure("out of memory"), RuntimeError("a library's own"), MemoryError()])
def test_a_model_that_fails_is_named_and_tried_again(
    solver: Solver, predictor: Predictor, monkeypatch: pytest.MonkeyPatch, fault: Exception
) -> None:
    with monkeypatch.context() as patch:
        broken(predictor, "solve", fault, patch)
        assert solver.step(wish()).missing == {"model": str(fault) or "MemoryError"}
    assert solver.step(wish()).missing == {}


def test_a_flat_picture_does_not_end_the_model_s_fault(
    solver: Solver, predictor: Predictor, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken(predictor, "solve", ModelFailure("out of memory"), monkeypatch)
    steps = [solver.step(wish()), solver.step(wish(None, flat=True)), solver.step(wish(None, flat=True))]
    assert steps[1].flat is not None
    assert [step.missing for step in steps] == [{"model": "out of memory"}] * 3


def test_where_even_the_flat_picture_fails_a_uniform_one_is_shown(
    state: SceneState, content: ContentSource, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        broken(content, "render", ContentFailure("gone"), patch)
        solver = Solver(state, SMALL)
        step = solver.step(wish(None, flat=True))
        assert step.missing == {"content": "gone"}
        assert np.ptp(step.flat.layers[..., :3], axis=(1, 2)).max() == 0
    step = solver.step(wish(None, flat=True))
    assert step.missing == {}
    assert step.flat.layers.std() > 1


def test_a_fault_that_is_over_is_cleared_without_new_work(
    solver: Solver, content: ContentSource, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A revision that could not be asked for once, while the head rests."""
    solver.step(wish())
    with monkeypatch.context() as patch:
        broken(content, "revision", ContentFailure("busy"), patch)
        assert solver.step(wish()).missing == {"content": "busy"}
    assert solver.step(wish()).missing == {}


@pytest.mark.parametrize(
    ("scene", "focus", "gets"),
    [("demo", "on", True), ("demo", "auto", False), ("flat card", "auto", True), ("pair", "on", False)],
)
def test_content_that_qualifies_gets_focus_and_no_other(
    solver: Solver, shared_context: Any, monkeypatch: pytest.MonkeyPatch, scene: str, focus: str, gets: bool
) -> None:
    """The demo scene reaches behind the rear panel; a pair has no other views."""
    settings = changed(solver.state.settings, "content", {"focus": focus}, source="test")
    card = shapes.card(0.1, 0.05)
    content = (
        Pair()
        if scene == "pair"
        else ProceduralSource(
            "demo" if scene == "demo" else Scene("card", (Thing(card, "checker", (0.05, 0.0, 0.0), (1, 1, 1)),)),
            stack=SMALL,
            context=shared_context,
        )
    )
    solver.replace(content=content, settings=settings)
    resting = replace(wish(), eyes_label="rested")
    plain = solver.step(resting).solution
    for _ in range(2):  # the second time, nothing is left to do
        update = solver.step(replace(resting, refined_to=Effort(1, 2, focus=True)))
        focused = update.solution
        assert ((focused is not None), update.missing) == (gets, {})
        broken(solver_module, "focused_job", ContentFailure("is not drawn again"), monkeypatch)
        if focused is not None:
            assert focused.effort == Effort(1, 2, focus=True)
            assert not np.array_equal(focused.layers, plain.layers)
            assert np.array_equal(focused.solved_for_m, EYES)
        gets = False
    content.close()


class Pair(ContentSource):
    """Two grey pictures, whatever the eyes see."""

    def __init__(self) -> None:
        self.info = ContentInfo("pair", fixed_views=True)

    def render(self, view: View, *, time_ns: int) -> U8:
        return np.full((view.height_px, view.width_px, 4), 60 + 100 * view.side, np.uint8)
