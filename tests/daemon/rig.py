"""A real loop with real content, network and offscreen panels, small; and parts of it that break when told to."""

from __future__ import annotations

import threading
import time
from contextlib import ExitStack
from dataclasses import replace
from typing import Any

import numpy as np
from runtime.frame.loop import Loop

from runtime.config import Settings
from runtime.daemon.build import RunOptions, build_loop
from runtime.errors import PanelLost
from runtime.records import EyePoints, FrameAccount, PanelFrame, PresentReport, SensorFrame, State
from runtime.sensor.base import Capabilities, SensorDriver
from runtime.sensor.registry import register_driver

SMALL: dict[str, Any] = {
    "stack": {"width_px": 192, "height_px": 108},
    "sensor": {
        "driver": "fragile", "timeout_s": 0.1, "reopen_backoff_s": 0.02, "reopen_backoff_max_s": 0.05,
        "open_timeout_s": 0.3,
    },
    "tracker": {"hold_s": 0.1, "blend_s": 0.02},
    "model": {"name": "fast", "threads": 1},
    "loop": {"rate_hz": 200.0},
}  # fmt: skip


class Plan:
    """What the sensor does next; shared by every driver that is opened."""

    def __init__(self) -> None:
        self.opened = 0
        self.fault: Exception | None = None
        self.refuse: Exception | None = None
        self.hang = threading.Event()  # set: calls don't return
        self.released = threading.Event()  # set: hung calls return after all
        self.eyes_m = np.array([[0.7, -0.031, 0.0], [0.7, 0.031, 0.0]])
        self.sway_m = 0.002
        self.noise_m = 0.0  # standard deviation of each axis of each eye
        self.clock_jump_ns = 0


class FragileDriver(SensorDriver):
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
        if self._plan.hang.is_set():
            self._plan.released.wait(30.0)
        if self._plan.fault is not None:
            raise self._plan.fault
        time.sleep(0.01)
        self._sequence += 1
        eyes_m = self._plan.eyes_m + np.array([0.0, self._plan.sway_m * np.sin(self._sequence / 10), 0.0])
        eyes_m = eyes_m + self._random.normal(0.0, self._plan.noise_m, (2, 3))
        capture_ns = self._clock.now_ns() + self._plan.clock_jump_ns
        return SensorFrame(self._sequence, capture_ns, EyePoints(eyes_m, np.ones(2)))

    def close(self) -> None:
        """Nothing to release."""


class Rig:
    """A loop and the means to break it. Use as a context manager."""

    def __init__(self, *, supervisor: Any = None, **changes: dict[str, Any]) -> None:
        self.plan = Plan()
        register_driver("fragile", lambda settings, clock, latency_ms: FragileDriver(self.plan, clock))
        tables = {name: {**SMALL.get(name, {}), **changes.get(name, {})} for name in {**SMALL, **changes}}
        self.settings = Settings.model_validate(tables)
        self._supervisor = supervisor
        self._cleanup = ExitStack()
        self.accounts: list[FrameAccount] = []

    def __enter__(self) -> Rig:
        self.loop: Loop = build_loop(
            self.settings, RunOptions(), self._cleanup, supervisor=self._supervisor, on_account=self.accounts.append
        )
        return self

    def __exit__(self, *exception: object) -> None:
        self.plan.released.set()
        self._cleanup.close()

    def turn_until(self, state: str, *, within_s: float = 10.0) -> FrameAccount:
        """Turns of the loop until its state is called this. Raises AssertionError where it never is."""
        deadline = time.monotonic() + within_s
        while time.monotonic() < deadline:
            account = self.loop.turn()
            if self.loop.machine.name == state:
                return account
        raise AssertionError(f"never {state}; {self.loop.machine.name} ({self.loop.machine.reason})")

    def turns(self, count: int) -> list[FrameAccount]:
        return [self.loop.turn() for _ in range(count)]


class BreakablePanels:
    """Any panels, which are lost while `lost` says so."""

    def __init__(self, panels: Any, *, keep: bool = True) -> None:
        self._panels, self.lost, self.name, self._keep = panels, "", panels.name, keep
        self.shown: list[PanelFrame] = []

    def present(self, frame: PanelFrame, *, unchanged: bool = False) -> PresentReport:
        if self.lost:
            raise PanelLost(self.lost)
        if self._keep:
            self.shown.append(replace(frame, solved=None if frame.solved is None else frame.solved.copy()))
        return self._panels.present(frame, unchanged=unchanged)

    def close(self) -> None:
        self._panels.close()


class BreakablePredictor:
    """Any predictor; `answer`, where set, is called in its place."""

    def __init__(self, predictor: Any) -> None:
        self._predictor, self.answer = predictor, None
        self.name, self.provider = predictor.name, predictor.provider

    def predict(self, images: Any, eyes_m: Any) -> Any:
        return (self.answer or self._predictor.predict)(images, eyes_m)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._predictor, name)


TRACKING = str(State.TRACKING)
