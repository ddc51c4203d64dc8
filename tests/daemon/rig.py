"""Small run with real content, network and offscreen panels, whose parts can be made to fail."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any
from unittest.mock import patch

import numpy as np

from runtime.config import Settings
from runtime.daemon.build import Host, Run, RunOptions, build_run, start_sensor, start_solver
from runtime.daemon.solver_parts import RunningSolver, SolverSetup
from runtime.errors import PanelLost
from runtime.frame.presenter import Presenter
from runtime.records import EyePoints, PanelFrame, PresentReport, RefreshAccount, SensorFrame, State
from runtime.sensor.base import Capabilities, Sensor
from runtime.sensor.live import LiveSamples, SensorSetup, SensorThread
from tests.daemon.inline import ThreadSolver

SMALL: dict[str, Any] = {
    "stack": {"width_px": 192, "height_px": 108},
    "sensor": {"driver": "fragile", "timeout_s": 0.1},
    "tracker": {"hold_s": 0.1},
    "model": {"name": "fast", "threads": 1, "backend": "cpu"},  # auto depends on the machine's load
    "loop": {"rate_hz": 200.0},
}
QUICK = {"sensor.polling.REOPEN_AFTER_S": 0.02, "sensor.polling.REOPEN_AFTER_MAX_S": 0.05, "frame.policy.BLEND_S": 0.02}


class Plan:
    """Plan of the sensor's behaviour; shared by every driver that is opened."""

    def __init__(self) -> None:
        self.opened = 0
        self.mend()

    def mend(self) -> None:
        """All is well from now on."""
        self.fault: Exception | None = None
        self.refuse: Exception | None = None
        self.eyes_m = np.array([[0.7, -0.031, 0.0], [0.7, 0.031, 0.0]])
        self.sway_m = 0.002
        self.noise_m = 0.0  # standard deviation of each axis of each eye


class FragileDriver(Sensor):
    """Two eyes that sway, a hundred times a second, until its plan says otherwise."""

    name = "fragile"
    capabilities = Capabilities(eye_points=True, in_stack_frame=True)

    def __init__(self, plan: Plan, clock: Any) -> None:
        self._plan, self._clock, self._sequence = plan, clock, 0
        self._random = np.random.default_rng(1)

    def open(self) -> None:
        if self._plan.refuse is not None:
            raise self._plan.refuse
        self._plan.opened += 1
        self.serial = "F-1"

    def read_newest(self, timeout_s: float) -> SensorFrame:
        if self._plan.fault is not None:
            raise self._plan.fault
        time.sleep(0.01)
        self._sequence += 1
        eyes_m = self._plan.eyes_m + np.array([0.0, self._plan.sway_m * np.sin(self._sequence / 10), 0.0])
        eyes_m = eyes_m + self._random.normal(0.0, self._plan.noise_m, (2, 3))
        capture_ns = self._clock.now_ns()
        return SensorFrame(self._sequence, capture_ns, EyePoints(eyes_m, np.ones(2)))

    def close(self) -> None:
        """Nothing to release."""


class Rig:
    """A run and the means to break it. Use as a context manager."""

    def __init__(
        self,
        *,
        host: Any = None,
        recorder: Any = None,
        late_s: float = 5.0,  # tolerate a busy machine
        in_process: bool = False,  # True to run the solver in a process, as it does outside of tests
        **changes: dict[str, Any],
    ) -> None:
        self._times = QUICK | {"frame.solver_process.LATE_S": late_s}
        self.plan = Plan()
        tables = {name: {**SMALL.get(name, {}), **changes.get(name, {})} for name in {**SMALL, **changes}}
        self.settings = Settings.model_validate(tables)
        self.host = host or Host()
        self.host.recorder = recorder or self.host.recorder
        self._in_process = in_process
        self._cleanup = ExitStack()
        self.accounts: list[RefreshAccount] = []

    def __enter__(self) -> Rig:
        try:
            for name, seconds in self._times.items():
                self._cleanup.enter_context(patch(f"runtime.{name}", seconds))
            self._cleanup.enter_context(patch("runtime.daemon.build.start_sensor", self._sensor_of))
            self._cleanup.enter_context(patch("runtime.daemon.build.start_solver", self._solver_of))
            self.run: Run = build_run(
                self.settings, RunOptions(), self._cleanup, self.host, on_account=self.accounts.append
            )
        except BaseException:
            self._cleanup.close()
            raise
        self._well = self.presenter.panels, None if self._in_process else self.predictor
        return self

    def _solver_of(self, settings: Settings, stack: Any, clock: Any, **how: Any) -> Any:
        if self._in_process:
            return start_solver(settings, stack, clock, **how)
        return ThreadSolver(SolverSetup(settings, stack), clock)

    def _sensor_of(self, settings: Settings, clock: Any, link: Any = None) -> LiveSamples:
        if settings.sensor.driver != "fragile":
            return start_sensor(settings, clock, link)
        return SensorThread(SensorSetup(lambda: FragileDriver(self.plan, clock), settings.sensor, clock))

    def mend(self) -> None:
        """Restore everything that was broken to its initial state."""
        self.plan.mend()
        self.presenter.panels, predictor = self._well
        if predictor is not None:
            self.parts.solver.replace(predictor=predictor)

    def __exit__(self, *exception: object) -> None:
        self._cleanup.close()

    @property
    def presenter(self) -> Presenter:
        return self.run.presenter

    @property
    def parts(self) -> RunningSolver:
        """The solver, unless it runs in a process."""
        solver = self.presenter.solver
        assert isinstance(solver, ThreadSolver)
        return solver.parts

    @property
    def content(self) -> Any:
        """Content currently drawn."""
        return self.parts.solver.state.content

    @property
    def predictor(self) -> Any:
        """Predictor currently in use."""
        return self.parts.solver.state.predictor

    def refresh_until(self, wanted: str | Callable[[], Any], *, within_s: float = 90.0) -> RefreshAccount:
        """Refreshes until the state is called this, or until it holds. Raises AssertionError where it never does."""
        deadline = time.monotonic() + within_s
        machine = self.presenter.machine
        while time.monotonic() < deadline:
            account = self.presenter.refresh()
            if machine.name == wanted if isinstance(wanted, str) else wanted():
                return account
        raise AssertionError(f"never {wanted}; {machine.name} ({machine.reason})")

    def refresh_until_solved(self, *, times: int = 1) -> RefreshAccount:
        """Refresh until `count` further solutions are shown."""
        for _ in range(times):
            ran = self.refresh_until(lambda: self.accounts[-1].inference == "ran")
        return ran

    def settle(self, work: Callable[[], object] = lambda: None) -> None:
        """Refresh until the solver has completed its current work and a refresh has shown it.

        work: done on the solver's thread between two solutions.
        """
        done = threading.Event()

        def between() -> None:
            work()
            done.set()

        solver = self.presenter.solver
        assert isinstance(solver, ThreadSolver)
        solver.between_steps(between)
        self.refresh_until(done.is_set)
        self.presenter.refresh()

    def refreshes(self, count: int) -> list[RefreshAccount]:
        return [self.presenter.refresh() for _ in range(count)]

    def refreshes_for(self, seconds: float) -> list[RefreshAccount]:
        """Refresh for this long."""
        deadline, done = time.monotonic() + seconds, []
        while time.monotonic() < deadline:
            done.append(self.presenter.refresh())
        return done

    def break_panels(self) -> BreakablePanels:
        """The panels, from now on in the hands of the test."""
        panels = BreakablePanels(self.presenter.panels)
        self.presenter.panels = panels  # type: ignore[assignment]
        return panels

    def break_predictor(self) -> BreakablePredictor:
        """The model, from now on in the hands of the test."""
        predictor = BreakablePredictor(self.predictor)
        self.parts.solver.replace(predictor=predictor)
        return predictor


class BreakablePanels:
    """Any panels, which are lost while `lost` says so."""

    def __init__(self, panels: Any) -> None:
        self._panels, self.lost, self.name = panels, "", panels.name
        self.shown: list[PanelFrame] = []

    def present(self, frame: PanelFrame, *, unchanged: bool = False, due_ns: int | None = None) -> PresentReport:
        if self.lost:
            raise PanelLost(self.lost)
        self.shown.append(frame)
        return self._panels.present(frame, unchanged=unchanged, due_ns=due_ns)

    def close(self) -> None:
        self._panels.close()

    @property
    def period_ns(self) -> int | None:
        return self._panels.period_ns


class BreakablePredictor:
    """Any predictor; `answer`, where set, is called in its place."""

    def __init__(self, predictor: Any) -> None:
        self._predictor = predictor
        self.answer: Callable[..., Any] | None = None

    def solve(self, job: Any, watch: Any = None) -> Any:
        return self._predictor.solve(job, watch) if self.answer is None else self.answer(job)

    def well(self, job: Any) -> Any:
        """Answer of the wrapped predictor."""
        return self._predictor.solve(job)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._predictor, name)


TRACKING = str(State.TRACKING)
