"""Fakes for the presenter's partners, which use a test clock and never wait."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from runtime.clock import NS_PER_MS, NS_PER_S, SimulatedClock
from runtime.config import Settings
from runtime.content.base import ContentInfo
from runtime.errors import EndOfRecording, PanelLost
from runtime.eyes.calibration import load_calibration
from runtime.frame.effort import Costs, simulated_costs
from runtime.frame.messages import Answer, Facts, Live, Order, SolverUpdate
from runtime.frame.pacing import Pacer
from runtime.frame.presenter import Presenter
from runtime.frame.refresh import Refresh
from runtime.frame.solver_host import SolverHost
from runtime.frame.viewer import Viewer
from runtime.model.base import ModelFacts
from runtime.optics.stack import PanelStack
from runtime.panels.base import PanelSink
from runtime.records import Effort, EyePoints, PanelFrame, PresentReport, SensorFrame, Solution, SolveRequest
from runtime.sensor.samples import Samples

STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 32, 18)
EYES = np.array([[0.6, -0.031, 0.0], [0.6, 0.031, 0.0]])
HZ = 60
PERIOD_NS = round(NS_PER_S / HZ)
STAGE_MS = {"sensor": 0.1, "track": 0.1, "present": 1.0}


def aside(y_m: float = 0.0, *, z_m: float = 0.0, x_m: float = 0.0) -> np.ndarray:
    """(2, 3) eyes that have moved from `EYES`."""
    return EYES + np.array([x_m, y_m, z_m])


def picture(code: int) -> np.ndarray:
    """(N, h, w, 4) of one grey."""
    return np.full((STACK.count, STACK.height_px, STACK.width_px, 4), code, np.uint8)


def solution(number: int, eyes_m: Any = EYES, *, time_ns: int = 0, **changes: Any) -> Solution:
    """Layers for a pair of eyes; None: the flat picture."""
    effort = None if eyes_m is None else Effort()
    return Solution(number, picture(number % 256), eyes_m, time_ns, **{"effort": effort, **changes})


class FakeSamples(Samples):
    """Delivers a test's samples once they have arrived; raises on request."""

    def __init__(self) -> None:
        self.waiting: list[SensorFrame] = []
        self.stale_inputs, self.serial = 0, "F-1"
        self.why = ""  # why there is no sensor
        self.ends_ns: int | None = None
        self._sequence = 0

    def put(self, eyes_m: Any, capture_ns: int, *, truth: bool = False) -> None:
        """A sample of eyes (2, 3), frame `stack`; None: no face."""
        self._sequence += 1
        points = None if eyes_m is None else EyePoints(np.array(eyes_m, float), np.ones(2))
        true_m = np.array(eyes_m, float) if truth else None
        self.waiting.append(SensorFrame(self._sequence, capture_ns, points, true_eyes_m=true_m))

    def arrived(self, now_ns: int) -> list[SensorFrame]:
        if self.ends_ns is not None and now_ns >= self.ends_ns:
            raise EndOfRecording("over")
        there = [frame for frame in self.waiting if frame.capture_ns <= now_ns]
        self.waiting = [frame for frame in self.waiting if frame.capture_ns > now_ns]
        return there

    def fault(self) -> str:
        return self.why

    def close(self) -> None:
        """Do nothing."""


def facts(settings: Settings, *, scene: int = 1, **offers: Any) -> Facts:
    """Of a model that offers no steps and only the full raster, unless told."""
    return Facts(0, scene, settings, ContentInfo("content"), ModelFacts("model", "none", **offers), "cpu", "")


class FakeSolver(SolverHost):
    """Returns a test's results, and records its requests."""

    def __init__(self, *, cost_ns: int = 20 * NS_PER_MS) -> None:
        super().__init__()
        self.solve_cost_ns = cost_ns
        self.reductions: tuple[int, ...] = (1,)  # whose costs are known
        self.offered: tuple[int, ...] = (1,)  # by the model
        self.there = SolverUpdate()
        self.requests: list[SolveRequest] = []
        self.orders: list[Order] = []
        self.settings = Settings()

    @property
    def costs(self) -> Costs:
        return simulated_costs({"inference": self.solve_cost_ns / NS_PER_MS}, self.reductions)

    def hand_over(self, *, solved: Solution | None = None, flat: Solution | None = None, **missing: str) -> None:
        self.there = SolverUpdate(solved or self.there.solution, flat or self.there.flat, missing)

    def free_ns(self, now_ns: int) -> int:
        return now_ns

    def post(self, request: SolveRequest) -> None:
        self.requests.append(request)

    def news(self) -> SolverUpdate:
        return self.there

    @property
    def facts(self) -> Facts:
        return facts(self.settings, reductions=self.offered)

    @property
    def live(self) -> Live:
        return Live()

    def _dispatch(self, order: Order) -> None:
        self.orders.append(order)

    def close(self) -> None:
        """Do nothing."""


class FakePanels(PanelSink):
    """Keeps the frames presented; lost while `lost` has a reason; reports blanks if given a display's period."""

    name = "fake"

    def __init__(self, clock: SimulatedClock) -> None:
        self._clock, self.lost = clock, ""
        self.shown: list[tuple[PanelFrame, bool]] = []  # and whether it was vouched to be unchanged

    def present(self, frame: PanelFrame, *, unchanged: bool = False, due_ns: int | None = None) -> PresentReport:
        if self.lost:
            raise PanelLost(self.lost)
        self.shown.append((frame, unchanged))
        return PresentReport(frame.number, self._clock.now_ns(), 0.25)

    def close(self) -> None:
        """Do nothing."""

    @property
    def frame(self) -> PanelFrame:
        """The newest."""
        return self.shown[-1][0]

    @property
    def unchanged(self) -> bool:
        """`unchanged` flag of the newest frame."""
        return self.shown[-1][1]


class FakeParts:
    """`SolverParts` whose steps are a test's own function."""

    def __init__(self, step: Callable[[SolveRequest], SolverUpdate], stage_ms: dict[str, float] | None = None) -> None:
        self.behave, self.stage_ms = step, stage_ms or {}
        self.asked: list[SolveRequest] = []
        self.orders: list[Order] = []
        self.answer: Callable[[Order], Answer] | None = None
        self.late: list[Answer] = []  # answers of the next turn
        self.closed = 0  # times
        self.costs_at_ns: list[int] = []

    def step(self, request: SolveRequest) -> SolverUpdate:
        self.asked.append(request)
        return self.behave(request)

    def simulated_costs(self) -> Costs:
        return simulated_costs(self.stage_ms, (1,))

    def turn(self, orders: Sequence[Order]) -> list[Answer]:
        self.orders += orders
        late, self.late = self.late, []
        return [*late, *(self.answer(order) for order in orders if self.answer is not None)]

    @property
    def facts(self) -> Facts:
        return facts(Settings())

    def live(self, time_ns: int) -> Live:
        return Live()

    def first_costs(self, *, time_ns: int) -> dict[int, dict[str, float]]:
        self.costs_at_ns.append(time_ns)
        return {1: {}}

    def close(self) -> None:
        self.closed += 1


class Watching:
    """An observer that keeps all reports."""

    def __init__(self) -> None:
        self.samples: list[SensorFrame] = []
        self.refreshes: list[Refresh] = []

    def sampled(self, sample: SensorFrame) -> None:
        self.samples.append(sample)

    def refreshed(self, refresh: Refresh) -> None:
        self.refreshes.append(refresh)


class Stage:
    """A presenter on a test clock, among fakes; a sensor of `sensor_hz` sees the eyes where `eyes` says."""

    def __init__(self, *, sensor_hz: float = 60.0, **tables: dict[str, Any]) -> None:
        defaults: dict[str, Any] = {"plan": {"enabled": False}}
        merged = {name: {**defaults.get(name, {}), **tables.get(name, {})} for name in {**defaults, **tables}}
        self.settings = Settings.model_validate(merged)
        self.clock = SimulatedClock(NS_PER_S)
        self.samples, self.solver, self.panels = FakeSamples(), FakeSolver(), FakePanels(self.clock)
        self.watching = Watching()
        calibration = load_calibration(None)
        self.viewer = Viewer(self.settings, calibration, front_m=max(STACK.x_m), in_stack_frame=True)
        self.pacer = Pacer(period_ns=PERIOD_NS, photon_ns=8 * NS_PER_MS, work_ns=round(1.2 * NS_PER_MS))
        self.presenter = Presenter(
            self.settings,
            STACK,
            clock=self.clock,
            pacer=self.pacer,
            samples=self.samples,
            viewer=self.viewer,
            solver=self.solver,
            panels=self.panels,
            stage_ms=STAGE_MS,
            observers=[self.watching],
        )
        self.eyes: Callable[[float], Any] = lambda time_s: EYES  # of seconds since the start; None: no face
        self._sensor_ns, self._next_ns, self._start_ns = round(NS_PER_S / sensor_hz), NS_PER_S, NS_PER_S

    def refresh(self, count: int = 1) -> list[Refresh]:
        """Run `count` refreshes; before each the sensor delivers its samples up to then."""
        done = []
        for _ in range(count):
            until_ns = self.clock.now_ns() + PERIOD_NS
            while self._next_ns <= until_ns:
                self.samples.put(self.eyes((self._next_ns - self._start_ns) / NS_PER_S), self._next_ns, truth=False)
                self._next_ns += self._sensor_ns
            self.presenter.refresh()
            assert self.presenter.last is not None
            done.append(self.presenter.last)
        return done

    def change(self, **plan: Any) -> None:
        """Other settings of the plan hold from the next refresh on."""
        settings = self.presenter.settings
        self.presenter.adopt(settings.model_copy(update={"plan": settings.plan.model_copy(update=plan)}))
