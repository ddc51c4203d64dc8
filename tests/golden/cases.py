"""Cases of the golden runs: recordings, settings, and actions or faults during a run."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from runtime.errors import ModelFailure
from runtime.frame.messages import Answer, ChangeSettings, Done
from runtime.frame.presenter import Presenter
from runtime.frame.solver_host import SimulatedSolver
from tests.golden.recordings import path_to

Action = Callable[[Presenter], None]
LOADED_WITHIN_S = 60.0  # real time; the simulated clock is stopped meanwhile


@dataclass(frozen=True, slots=True)
class Case:
    """One golden run."""

    recording: str
    tables: dict[str, dict[str, Any]] = field(default_factory=dict)  # settings in addition to SMALL
    actions: dict[int, Action] = field(default_factory=dict)  # before the refresh of that number
    pictures: tuple[int, ...] = ()  # refreshes whose panels are kept

    @property
    def mounted(self) -> bool:
        """Return True if panels rotate, mirror or curve their layers."""
        return "output" in self.tables

    def settings(self) -> dict[str, Any]:
        """Tables of the configuration."""
        tables = {name: dict(values) for name, values in SMALL.items()}
        for name, values in self.tables.items():
            tables[name] = tables.get(name, {}) | values
        tables["sensor"] = {"driver": "replay", "source": str(path_to(self.recording))}
        return tables


SMALL: dict[str, dict[str, Any]] = {
    "stack": {"width_px": 96, "height_px": 54},
    "model": {"name": "balanced", "threads": 1, "backend": "cpu", "effort": "full"},
    "loop": {"evaluate_every": 20},
}


SLOW: dict[str, Any] = {
    "simulated_stage_ms": {
        "sensor": 0.1, "track": 0.1, "present": 2,
        "render": 44, "prepare": 40, "inference": 31, "finish": 38, "step": 85,
    }
}  # fmt: skip


def change_scene(name: str) -> Action:
    """`ctl scene`, complete before the simulated clock continues."""

    def do(presenter: Presenter) -> None:
        present = presenter.settings
        settings = present.model_copy(update={"content": present.content.model_copy(update={"scene": name})})
        deadline_s, answers = time.monotonic() + LOADED_WITHIN_S, list[Answer]()
        presenter.solver.send(ChangeSettings(settings, reload_content=True), answers.append)
        while not (answers and isinstance(answers[-1], Done)):
            assert time.monotonic() < deadline_s, "the scene does not load"
            time.sleep(0.005)
            solver_of(presenter).look()
        assert not answers[-1].problem, answers[-1].problem
        presenter.adopt(settings)

    return do


def solver_of(presenter: Presenter) -> SimulatedSolver:
    assert isinstance(presenter.solver, SimulatedSolver)
    return presenter.solver


def model_of(presenter: Presenter) -> Any:
    """The model, which lives in the same process on a simulated clock."""
    parts: Any = solver_of(presenter).parts
    return parts.solver.state.predictor


def ask_flat(presenter: Presenter) -> None:
    """`ctl flat`."""
    presenter.flat_asked = True


def resume(presenter: Presenter) -> None:
    """`ctl resume`."""
    presenter.paused = presenter.flat_asked = False


def pause(presenter: Presenter) -> None:
    """`ctl pause`."""
    presenter.paused = True


def break_model(presenter: Presenter) -> None:
    """From now on the model raises."""

    def solve(*_: Any, **__: Any) -> Any:
        raise ModelFailure("a golden run's model is broken")

    vars(model_of(presenter))["solve"] = solve


def mend_model(presenter: Presenter) -> None:
    """The model answers again."""
    del vars(model_of(presenter))["solve"]


# Each panel mounted another way: none shows its layer as it is.
MOUNTED: list[dict[str, Any]] = [
    {"rotation_deg": 180, "gamma": 2.0},
    {"mirror": "horizontal"},
    {"rotation_deg": 180, "mirror": "vertical"},
    {"homography": ((0.98, 0.03, 1.0), (-0.01, 1.01, 0.5), (0.0001, 0.0, 1.0))},
]

CASES = {
    "still": Case("still", pictures=(60, 110)),
    "walk": Case("walk", {"model": {"name": "fast"}, "content": {"scene": "moving"}}, pictures=(40, 75)),
    "loss-and-return": Case("loss-and-return", {"model": {"name": "best"}}, pictures=(60, 130)),
    "scenes": Case(
        "nod",
        {"content": {"scene": "texture"}},
        {30: change_scene("demo"), 60: ask_flat, 85: resume, 105: pause},
        pictures=(25, 50, 84, 110),
    ),
    "fault": Case("lean", {}, {25: break_model, 50: mend_model}, pictures=(48, 70)),
    "four-panels": Case(
        "lean",
        {"stack": {"x_m": (-0.05, -0.02, 0.01, 0.05)}, "content": {"scene": "demo"}, "output": {"panels": MOUNTED}},
        pictures=(50,),
    ),
    "two-people": Case(
        "two",
        {"stack": {"x_m": (-0.09, -0.03, 0.03, 0.09)}, "content": {"scene": "demo"}, "tracker": {"join_s": 0.2}},
        pictures=(60,),
    ),
    # The effort is chosen, on a slow processor: coarse rasters in motion.
    "live-lean": Case("lean", {"model": {"effort": "auto"}, "loop": SLOW}),
}
