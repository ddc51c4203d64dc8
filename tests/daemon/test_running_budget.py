"""A time budget in a running solver: lighter when solutions really take longer, back again when they don't."""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from runtime.frame.timing import SOLVING_STAGES
from runtime.model.unrolled import UnrolledPredictor
from runtime.plan.ladder import rungs
from runtime.plan.levels import QualityLevel, useful
from runtime.plan.predictors import LADDER
from runtime.records import RefreshAccount
from tests.daemon.gl_soak import objects
from tests.daemon.rig import Rig
from tests.daemon.test_changes import Served, configuration
from tests.test_cli import phasestack

MOVING = {
    "model": {"name": "best"},
    "content": {"scene": "moving"},
    "loop": {"rate_hz": 200.0, "evaluate_every": 0},
    "tracker": {"hold_s": 5.0},
}
ROOM = 4.0  # of the budget over what the best level takes: the machine may be busy with other things


def levels_of(served: Served) -> Any:
    """Those that were measured; none before the solver has taken over that there is a budget."""
    return (served.budget.describe() or {"levels": []})["levels"]


def lightest(levels: list[dict[str, Any]]) -> str:
    """The last of what `useful` leaves."""
    return useful([QualityLevel(**level) for level in levels])[-1].label


def solving_ms(accounts: list[RefreshAccount]) -> list[float]:
    """What each solution took, of those that were first shown by these refreshes."""
    ran = [account for account in accounts if account.inference == "ran"]
    return [sum(account.stage_ms[stage] for stage in SOLVING_STAGES) for account in ran]


@pytest.fixture
def slowness(monkeypatch: pytest.MonkeyPatch) -> dict[str, float]:
    """What every prediction takes longer than it does, in seconds."""
    real, added = UnrolledPredictor.predict, {"s": 0.0}

    def predict(self: UnrolledPredictor, images: Any, eyes_m: Any, **how: Any) -> Any:
        if threading.current_thread().name.startswith("solver"):  # levels are measured beside it
            time.sleep(added["s"])
        return real(self, images, eyes_m, **how)

    monkeypatch.setattr(UnrolledPredictor, "predict", predict)
    return added


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    with Served(tmp_path, **MOVING) as made:
        yield made


def test_it_goes_lighter_while_frames_are_slow_and_back_when_they_are_not(
    served: Served, slowness: dict[str, float], caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, frames in (("PATIENCE", 20), ("SLOW_FRAMES", 3), ("LOOK_BACK", 4)):
        monkeypatch.setattr(f"runtime.plan.levels.{name}", frames)
    caplog.set_level(logging.INFO, logger="phasestack.budget")
    rig, budget = served.rig, served.budget
    assert served.status()["budget"] is None
    rig.refresh_until_solved(times=5)
    assert served.asked("budget", 5000.0) == {"ok": True}
    rig.refresh_until(lambda: levels_of(served))
    levels = budget.describe()["levels"]
    assert [level["model"] for level in levels] == [name for name, _ in LADDER]
    # In a budget with room for everything the best level is shown, which may be none of the configured model.
    best = max(levels, key=lambda level: level["psnr_db"])
    rig.refresh_until(lambda: budget.describe()["level"] == best["model"])
    room_ms = ROOM * max(level["expected_ms"] for level in levels)
    assert served.asked("budget", room_ms) == {"ok": True}
    assert budget.describe()["levels"] == levels  # known already: nothing is measured again
    rig.refresh_until_solved(times=20)
    assert budget.describe()["level"] == best["model"]

    slowness["s"] = 1.2 * room_ms / 1000
    before = len(rig.accounts)
    rig.refresh_until(lambda: budget.describe()["level"] == lightest(levels))
    rig.refresh_until(lambda: budget.describe()["held"] is False)
    slow = solving_ms(rig.accounts[before:])
    status = budget.describe()
    assert status["saves_ms"] > 0
    assert status["costs_db"] > 0
    (item,) = [item for item in served.run.summary()["plan"] if item["what"] == "model or resolution"]
    assert status["level"] in item["why"]
    assert (item["saves_ms"], item["costs_db"]) == (round(status["saves_ms"], 2), round(status["costs_db"], 3))
    # The switches themselves stall nothing: no solution took as long as two of the slow ones.
    assert max(slow) < 2 * np.median(slow)

    slowness["s"] = 0.0
    rig.refresh_until(lambda: budget.describe()["level"] == best["model"])
    rig.refresh_until_solved(times=10)
    assert budget.describe()["held"]
    assert all(account.presented for account in rig.accounts)
    told = [record.getMessage() for record in caplog.records]
    assert any("frames took longer" in line for line in told)
    assert any("there has been room" in line for line in told)
    assert served.asked("budget", 0.0) == {"ok": True}
    rig.refresh_until(lambda: served.rig.predictor.name == "best" and budget.describe() is None)
    rig.refresh_until(lambda: served.status()["budget"] is None)


def test_without_a_reason_it_does_not_swing(served: Served) -> None:
    rig, budget = served.rig, served.budget
    served.asked("budget", 5000.0)
    rig.refresh_until(lambda: levels_of(served))
    served.asked("budget", ROOM * max(level["expected_ms"] for level in budget.describe()["levels"]))
    rig.refresh_until_solved(times=100)  # more than it waits before it tries a better level
    assert budget.describe()["switches"] == 0


def test_the_levels_are_measured_anew_for_another_scene(served: Served) -> None:
    budget = served.budget
    served.asked("budget", 5000.0)
    served.rig.refresh_until(lambda: levels_of(served))
    first = budget.describe()["levels"]
    assert served.asked("scene", "sparse") == {"ok": True}
    served.rig.refresh_until(lambda: levels_of(served) not in ([], first))
    assert not budget.describe()["problem"]


def test_a_reload_with_another_model_and_budget_leaves_nothing_of_the_old(served: Served) -> None:
    served.asked("budget", 5000.0)
    served.rig.refresh_until(lambda: levels_of(served))
    served.config.write_text(
        configuration(name="sart", budget_ms=0.001).replace("rate_hz", "evaluate_every = 0\nrate_hz")
    )
    assert served.asked("reload") == {"ok": True}
    served.rig.refresh_until(lambda: levels_of(served))
    assert {level["model"] for level in served.budget.describe()["levels"]} == {"sart"}
    wanted = lightest(served.budget.describe()["levels"])
    served.rig.refresh_until(lambda: served.budget.describe()["level"] == wanted)


def test_a_budget_in_the_settings_is_chosen_before_the_first_frame() -> None:
    with Rig(model={"name": "best", "budget_ms": 0.001}) as rig:
        rig.refresh_until("tracking")
        rig.refresh_until_solved()
        assert rig.run.parts.budget.describe()["level"] == lightest(rig.run.parts.budget.describe()["levels"])
        (item,) = [item for item in rig.run.summary()["plan"] if item["what"] == "model or resolution"]
        assert item["costs_db"] > 0


def test_what_can_t_be_cut_is_offered_at_fewer_pixels() -> None:
    with Rig(stack={"width_px": 64, "height_px": 36, "x_m": (-0.06, 0.0, 0.02)}) as rig:
        names = rungs(rig.settings, rig.presenter.stack)
        assert names == (("fast", 1.0), ("fast", 0.75), ("fast", 0.5))


def test_levels_are_measured_as_the_loop_solves_and_leave_nothing_in_the_gpu(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, ways = UnrolledPredictor.predict, set()

    def predict(self: UnrolledPredictor, images: Any, eyes_m: Any, **how: Any) -> Any:
        ways.add((self.backend, threading.current_thread().name.split("-")[0]))
        return real(self, images, eyes_m, **how)

    with Served(tmp_path, **{**MOVING, "model": {"name": "best", "backend": "gl"}}) as served:
        rig, counts = served.rig, []
        monkeypatch.setattr(UnrolledPredictor, "predict", predict)
        for _ in range(3):
            served.asked("budget", 5000.0)
            rig.refresh_until(lambda: levels_of(served))
            rig.refresh_until_solved()
            served.asked("budget", 0.0)
            rig.refresh_until(lambda: rig.predictor.name == "best" and served.budget.describe() is None)
            rig.settle()
            counts.append(objects(rig.presenter.panels.group))
    assert ways == {("gl", "solver")}
    assert counts[2] == counts[1]  # the first compiled programs


def test_what_is_being_measured_at_the_end_is_closed_on_the_solver_s_thread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    closed: list[str] = []
    real = UnrolledPredictor.close

    def close(self: UnrolledPredictor) -> None:
        closed.append(threading.current_thread().name.split("-")[0])
        real(self)

    with Served(tmp_path, **{**MOVING, "model": {"name": "best", "backend": "gl"}}) as served:
        served.asked("budget", 5000.0)
        served.rig.refresh_until(lambda: (served.budget.describe() or {}).get("measuring"))
        monkeypatch.setattr(UnrolledPredictor, "close", close)
    assert set(closed) <= {"solver", "MainThread"}


def test_the_choice_is_the_same_every_time_on_a_simulated_clock(tmp_path: Path) -> None:
    arguments = ("--replay", "demo", "--headless", "--max-speed", "--frames", "5", "--scale", "0.1")
    levels = set()
    for name in ("a", "b"):
        result = phasestack("run", *arguments, "--budget-ms", "12", "--out", tmp_path / name)
        assert result.returncode == 0, result.stderr
        plan = json.loads((tmp_path / name / "summary.json").read_text())["plan"]
        (item,) = [item for item in plan if item["what"] == "model or resolution"]
        levels.add((item["why"], item["saves_ms"], item["costs_db"]))
    assert len(levels) == 1
    assert (tmp_path / "a" / "frames.jsonl").read_bytes() == (tmp_path / "b" / "frames.jsonl").read_bytes()
