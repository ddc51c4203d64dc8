"""Tests that a run with injected faults degrades with a reason, loses no refresh and recovers."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from runtime.clock import MonotonicClock
from runtime.daemon.build import Host
from runtime.daemon.notify import Notifier
from runtime.errors import ContentFailure, ModelFailure, SensorLost
from runtime.frame.refresh import Status
from runtime.model.session import ModelSession
from runtime.records import RefreshAccount
from tests.daemon.rig import TRACKING, Rig
from tests.daemon.test_notify import Supervisor
from tests.faults import FAULTS, tried
from tests.soak import soak


@pytest.fixture(scope="module")
def running() -> Iterator[Rig]:
    with Rig() as made:
        made.refresh_until(TRACKING)
        yield made


@pytest.fixture
def rig(running: Rig) -> Iterator[Rig]:
    """A healthy run, repaired after each test."""
    running.refresh_until_solved()
    yield running
    running.mend()
    running.refresh_until(TRACKING)


def presented_all(accounts: list[RefreshAccount]) -> bool:
    return all(account.presented for account in accounts)


def alignments(rig: Rig, count: int) -> int:
    """Number of different alignments in `count` refreshes."""
    found = set()
    for _ in range(count):
        rig.presenter.refresh()
        found.add(rig.presenter.last.frame.solved_from_shown[0].tobytes())
    return len(found)


@pytest.mark.parametrize("fault", [SensorLost("unplugged"), RuntimeError("SDK confused")])
def test_a_sensor_that_raises_degrades_and_comes_back(rig: Rig, fault: Exception) -> None:
    rig.plan.fault = fault
    rig.refresh_until("degraded: sensor")
    assert str(fault.args[-1]) in rig.presenter.machine.reason
    assert presented_all(rig.refreshes(3))
    opened = rig.plan.opened
    rig.plan.fault = None
    rig.refresh_until(TRACKING)
    assert rig.plan.opened > opened


def held_as_it_was(rig: Rig) -> tuple[int, np.ndarray]:
    """Number of the solution that is shown, and a copy of its layers."""
    solution = rig.presenter.last.solution
    return solution.number, solution.layers.copy()


@pytest.mark.parametrize("fault", [ModelFailure("out of memory"), MemoryError()])
def test_a_model_that_raises_keeps_the_last_solution_aligned_to_the_eyes(rig: Rig, fault: Exception) -> None:
    def fail(job: Any) -> Any:
        raise fault

    predictor = rig.break_predictor()
    rig.refresh_until_solved(times=2)
    predictor.answer = fail
    account = rig.refresh_until("degraded: model")
    assert account.presented
    number, layers = held_as_it_was(rig)
    assert alignments(rig, 50) > 10
    assert rig.presenter.last.solution.number == number
    assert np.array_equal(rig.presenter.last.frame.solved, layers)
    assert rig.presenter.stats.faults["model"] >= 1
    predictor.answer = None
    rig.refresh_until(TRACKING)
    rig.refresh_until_solved()


def test_a_model_that_answers_nan_is_a_model_that_failed(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(
            ModelSession, "run", lambda *_: dict.fromkeys(("rear", "front", "check"), np.full(1, np.nan, np.float32))
        )
        account = rig.refresh_until("degraded: model")
        assert account.presented
        number, _ = held_as_it_was(rig)
        rig.refreshes(20)
        assert rig.presenter.last.solution.number == number
    rig.refresh_until(TRACKING)


@pytest.mark.parametrize("fault", [ContentFailure("no such frame"), ZeroDivisionError()])
def test_content_that_raises_keeps_the_last_picture(
    rig: Rig, fault: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*arguments: Any, **keywords: Any) -> Any:
        raise fault

    with monkeypatch.context() as patch:
        patch.setattr(rig.content, "draw", fail)
        patch.setattr(rig.content, "revision", lambda time_ns: time_ns)
        account = rig.refresh_until("degraded: content")
        assert account.presented
        assert presented_all(rig.refreshes(20))
    rig.refresh_until(TRACKING)


# --- the watchdog --------------------------------------------------------------------------------------------------


class Watched(Host):
    """The daemon's part that feeds the watchdog."""

    def __init__(self, notifier: Notifier) -> None:
        self.notifier = notifier

    def refreshed(self, status: Status) -> None:
        account = status.refresh.account
        self.notifier.refreshed(account.state, status.missing, presented=account.presented)


WATCHDOG_S = 0.4


@pytest.fixture
def heard(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Supervisor]:
    made = Supervisor(str(tmp_path / "notify"))
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    yield made
    made.close()


@pytest.fixture
def fed(heard: Supervisor) -> Iterator[Rig]:
    notifier = Notifier(MonotonicClock(), {"WATCHDOG_USEC": str(int(WATCHDOG_S * 1e6))})
    with Rig(host=Watched(notifier), late_s=0.3) as rig:
        rig.refresh_until_solved()
        rig.refresh_until(TRACKING)
        assert "WATCHDOG=1" in heard.heard()
        yield rig
    notifier.close()


def test_the_watchdog_outlives_a_hung_solver_but_not_an_endless_refresh(fed: Rig, heard: Supervisor) -> None:
    """The presenter's clock alone feeds it: there is a picture, it follows the eyes, and the solver is restarted."""
    gate = threading.Event()
    predictor = fed.break_predictor()
    predictor.answer = lambda job: gate.wait(60.0) and predictor.well(job)
    fed.refresh_until("degraded: model")
    heard.heard()
    fed.refreshes_for(2 * WATCHDOG_S)
    gate.set()
    assert heard.heard().count("WATCHDOG=1") >= 1
    panels, spoken = fed.break_panels(), []
    present = panels.present

    def slow(frame: Any, *, unchanged: bool = False, due_ns: int | None = None) -> Any:
        heard.heard()
        time.sleep(WATCHDOG_S * 1.5)
        spoken.extend(heard.heard())
        return present(frame, unchanged=unchanged, due_ns=due_ns)

    panels.present = slow  # type: ignore[method-assign]
    fed.refreshes(1)
    assert "WATCHDOG=1" not in spoken  # only the presenter feeds it: the solver kept running meanwhile
    panels.present = present  # type: ignore[method-assign]
    fed.refreshes_for(WATCHDOG_S)
    assert "WATCHDOG=1" in heard.heard()


@pytest.mark.slow
def test_faults_and_changes_pile_nothing_up_and_all_requests_are_answered() -> None:
    soak(90.0, growth_mib=200)  # so early, everything still grows


@pytest.mark.slow
def test_every_fault_has_its_reason_and_the_display_recovers() -> None:
    reasons = {f"{fault.role}: {fault.what}": costs.reasons[0] for fault, costs in tried(FAULTS, size_px=(192, 108))}
    ends = {"SIGSEGV": "SIGSEGV", "SIGKILL": "SIGKILL", "sys.exit": "no licence", "memory": "memory limit",
            "context": "reset the GPU", "load crashes": "SIGSEGV"}  # fmt: skip
    for name, reason in reasons.items():
        assert ends.get(name.partition(": ")[2], "not answered in time") in reason, reasons
