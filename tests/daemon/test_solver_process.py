"""Tests that a solver which crashes, hangs or takes too much costs no refresh, and that a new one takes over."""

from __future__ import annotations

import os
import re
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from runtime.frame.messages import Answer, ChangeSettings, Done, Draw, Drawn, Move, Skip
from runtime.frame.presenter import Presenter
from runtime.records import RefreshAccount
from tests.daemon.rig import TRACKING, Rig

STEP_S = 5.0
MEMORY_BYTES = 1 << 29
REASONS = {
    "crash": "SIGSEGV",
    "loop": "has not answered",
    "grow": "memory limit",
    "lose": "the driver reset the GPU",
}


@pytest.fixture(scope="module")
def deed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """File that says what the scene is to do."""
    return tmp_path_factory.mktemp("scene") / "deed"


@pytest.fixture(scope="module")
def running(deed: Path) -> Iterator[Rig]:
    scene = {"scene": "tests.daemon.scenes:Harmful", "options": {"file": str(deed)}}
    steady: dict[str, Any] = {"sensor": {"timeout_s": 5.0}, "tracker": {"hold_s": 20.0}, "content": scene}
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("STATE_DIRECTORY", str(deed.parent))
        patch.setattr("runtime.daemon.build.STEP_S", STEP_S)
        patch.setattr("runtime.daemon.build.SOLVER_MEMORY_BYTES", MEMORY_BYTES)
        with Rig(in_process=True, late_s=0.3, **steady) as made:
            made.refresh_until_solved()
            made.refresh_until(TRACKING)
            yield made


@pytest.fixture
def rig(running: Rig) -> Rig:
    """A healthy run that shows solutions."""
    running.refresh_until(lambda: not running.presenter.missing)
    running.refresh_until_solved(times=2)
    return running


def solver_pid(presenter: Presenter) -> int:
    (status,) = presenter.solver.status()
    pid = status["pid"]
    assert isinstance(pid, int)
    return pid


def until_replaced(rig: Rig, restarts: int, reasons: set[str] | None = None) -> list[RefreshAccount]:
    """Refresh until another solver's first solution is shown; return the accounts, and add the reasons to the set."""
    first = len(rig.accounts)
    rig.refresh_until(lambda: "model" in rig.presenter.missing)
    shown = rig.presenter.last.solution  # type: ignore[union-attr]
    assert shown is not None
    before = shown.layers.copy()
    if reasons is not None:
        reasons.add(rig.presenter.machine.reason)
    rig.refresh_until(lambda: rig.presenter.solver.restarts > restarts and "model" not in rig.presenter.missing)
    assert np.array_equal(shown.layers, before)  # never torn, although the slot of the next one was being written
    rig.refresh_until_solved(times=2)
    return rig.accounts[first:]


@pytest.mark.parametrize("what", REASONS)
def test_whatever_ends_a_solver_every_refresh_is_presented_and_another_takes_over(
    rig: Rig, deed: Path, what: str
) -> None:
    restarts, reasons = rig.presenter.solver.restarts, set[str]()
    pid = solver_pid(rig.presenter)
    deed.write_text(what)
    rig.refresh_until(lambda: reasons.add(rig.presenter.machine.reason) or rig.presenter.solver.restarts > restarts)
    accounts = until_replaced(rig, restarts, reasons)
    assert any(REASONS[what] in reason for reason in reasons), reasons
    assert all(account.presented for account in accounts)
    assert len({account.eyes_m.tobytes() for account in accounts if account.eyes_m is not None}) > 10
    numbers = [account.solution for account in accounts if account.solution is not None]
    assert numbers == sorted(numbers) and not psutil.pid_exists(pid)
    assert rig.presenter.stats.dropped == 0


def test_a_scene_that_calls_exit_ends_no_solver(rig: Rig, deed: Path) -> None:
    """At every drawing, because the next one could make good for a single exit within a refresh."""
    restarts, written = rig.presenter.solver.restarts, deed.with_name("written")

    def is_told() -> bool:
        written.write_text("exit")
        written.replace(deed)
        return "no licence" in rig.presenter.missing.get("content", "")

    rig.refresh_until(is_told)
    deed.unlink(missing_ok=True)
    rig.refresh_until_solved()
    assert rig.presenter.solver.restarts == restarts


@pytest.mark.parametrize("how", [signal.SIGSEGV, signal.SIGKILL, signal.SIGSTOP])
def test_a_solver_that_is_ended_from_outside_is_replaced_without_leaks(
    rig: Rig, how: int, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", "phasestack")
    me = psutil.Process()

    def replace_it() -> tuple[int, int, int]:
        restarts = rig.presenter.solver.restarts
        os.kill(solver_pid(rig.presenter), how)
        until_replaced(rig, restarts)
        return me.num_fds(), me.num_threads(), len(me.children())

    assert replace_it() == replace_it()
    assert "degraded: model (" in caplog.text and not re.search(r"\(model: |for 0 ms", caplog.text)


def problem_of(rig: Rig, order: Any) -> str:
    """Why an order was refused; empty if it was carried out."""
    answer = answered(rig, order)
    assert isinstance(answer, Done)
    return answer.problem


def answered(rig: Rig, order: Any) -> Answer:
    answers: list[Answer] = []
    rig.presenter.solver.send(order, answers.append)
    rig.refresh_until(lambda: bool(answers) and isinstance(answers[-1], Done | Drawn))
    return answers[-1]


def test_the_next_solver_takes_up_scene_model_and_place_as_last_set(rig: Rig) -> None:
    solver, settings = rig.presenter.solver, rig.presenter.settings
    content = settings.content.model_copy(update={"scene": "demo", "options": {}})
    model = settings.model.model_copy(update={"name": "balanced"})
    try:
        other = settings.model_copy(update={"content": content, "model": model})
        assert not problem_of(rig, ChangeSettings(other)) and not problem_of(rig, Move({"scale": 1.5}))
        facts, costs = solver.facts, solver.costs
        restarts = solver.restarts
        os.kill(solver_pid(rig.presenter), signal.SIGSEGV)
        until_replaced(rig, restarts)
        assert (solver.facts.info.name, solver.facts.model.name) == (facts.info.name, "balanced")
        assert solver.facts.settings.content.scale == 1.5 and solver.facts.settings == facts.settings
        assert solver.costs.stages.keys() == costs.stages.keys()
    finally:
        answered(rig, ChangeSettings(settings))


def test_a_scene_that_hangs_or_crashes_while_it_loads_is_refused(rig: Rig, deed: Path) -> None:
    settings = rig.presenter.settings
    options = {"file": str(deed), "making": True}
    content = settings.content.model_copy(update={"options": options})
    deed.write_text("crash")
    change = ChangeSettings(settings.model_copy(update={"content": content}))
    assert "restarted with the old settings" in problem_of(rig, change)
    rig.refresh_until_solved(times=2)
    assert rig.presenter.solver.facts.settings.content.options == {"file": str(deed)}


@pytest.mark.parametrize("making", [True, False])
def test_a_scene_that_takes_seconds_to_take_over_is_no_fault(rig: Rig, deed: Path, making: bool) -> None:
    settings, faults = rig.presenter.settings, dict(rig.presenter.stats.faults)
    other = deed.with_name("other")  # the present scene must not do it
    options = {"file": str(other), "making": making}
    other.write_text("nap")
    content = settings.content.model_copy(update={"options": options})
    reasons: set[str] = set()
    answers: list[Answer] = []
    rig.presenter.solver.send(ChangeSettings(settings.model_copy(update={"content": content})), answers.append)
    rig.refresh_until(lambda: reasons.add(rig.presenter.machine.reason) or any(isinstance(a, Done) for a in answers))
    rig.refresh_until(lambda: reasons.add(rig.presenter.machine.reason) or not other.exists())
    rig.refresh_until_solved()
    assert rig.presenter.stats.faults == faults, reasons
    assert not problem_of(rig, ChangeSettings(settings))


def test_orders_to_a_solver_that_has_ended_are_answered(rig: Rig) -> None:
    solver, answers = rig.presenter.solver, list[Answer]()
    restarts, pid = solver.restarts, solver_pid(rig.presenter)
    os.kill(pid, signal.SIGSTOP)
    skip = solver.send(Skip(0), answers.append)
    eyes_m = np.array([[0.7, -0.03, 0.0], [0.7, 0.03, 0.0]])
    draw = solver.send(Draw({"true": (eyes_m, 0)}, None, 40.0), answers.append)
    os.kill(pid, signal.SIGKILL)
    rig.refresh_until(lambda: solver.restarts > restarts and len(answers) == 2)
    assert {answer.number for answer in answers} == {skip, draw} and Drawn(draw, None) in answers
    drawn = answered(rig, Draw({"true": (eyes_m, 0)}, solver.facts.scene, 40.0))
    assert isinstance(drawn, Drawn) and drawn.targets is not None and drawn.targets.true is not None
    assert drawn.targets.true[0].shape == (108, 192, 3)
    assert answered(rig, Draw({"true": (eyes_m, 0)}, -1, 40.0)) == Drawn(solver._sent, None)


def test_the_status_names_a_playlists_new_entry(tmp_path: Path) -> None:
    shows = "".join(f'[[show]]\nscene = "{name}"\nseconds = 500\n' for name in ("flat", "grey"))
    (tmp_path / "two.toml").write_text(shows)
    with Rig(in_process=True, late_s=0.3, content={"scene": str(tmp_path / "two.toml")}) as rig:
        rig.refresh_until_solved()
        assert rig.presenter.solver.facts.info.name == "two: flat (1 of 2)"
        rig.presenter.solver.send(Skip(rig.presenter.clock.now_ns()))
        rig.refresh_until(lambda: rig.presenter.solver.facts.info.name == "two: grey (2 of 2)")
