"""Main function of the solver's process, which hands solutions over in shared memory."""

from __future__ import annotations

import os
import time
from dataclasses import replace

import cv2
import numpy as np

from runtime.clock import NS_PER_MS
from runtime.content import program_link
from runtime.daemon.solver_parts import RunningSolver, SolverSetup
from runtime.frame.effort import REST, CostBook, stages_for
from runtime.frame.messages import Busy, Idle, Live, Order, Slot, SolverUpdate, Stepped
from runtime.frame.solver_host import first_request
from runtime.model.buffers import LayerSlots
from runtime.records import SOLVING_STAGES, Solution, SolveRequest
from runtime.support.channel import Channel
from runtime.support.memory import keep_freed_memory
from runtime.support.process import Parent, Role
from runtime.support.untrusted_input import LIMITS

NICENESS = 5  # the presenter takes precedence
IDLE_S = 2.0  # time limit for anything between steps
LOOK_S = 0.25  # interval for publishing what changes by itself while no requests arrive
CHANGING_S = 0.02  # interval for looking whether a change has been loaded while no requests arrive
NO_LAYERS = np.empty((0, 0, 0, 4), np.uint8)


def role(memory_bytes: int) -> Role:
    """Return the solver's role, with a limit for its own memory."""
    return Role("solver", main, niceness=NICENESS, memory_bytes=memory_bytes, start_s=LIMITS.start_s)


def main(parent: Parent, memory: int, setup: SolverSetup) -> None:
    """Solve until the parent closes the channel. `memory` is the descriptor of the layers' shared memory."""
    keep_freed_memory()  # before any thread is started
    cv2.setNumThreads(setup.settings.model.threads or -1)
    slots = LayerSlots(memory, setup.stack)
    os.close(memory)
    if setup.programs is not None:
        program_link.use(Channel.of(setup.programs))
    _Serving(parent, RunningSolver(setup, slots=slots), slots, step_s=setup.step_s).run()


class _Serving:
    """A solver that serves its parent."""

    def __init__(self, parent: Parent, parts: RunningSolver, slots: LayerSlots, *, step_s: float) -> None:
        self._parent, self._parts, self._slots, self._step_s = parent, parts, slots, step_s
        self._costs = CostBook(parts.first_costs(time_ns=time.monotonic_ns()))
        self._live = Live()

    def run(self) -> None:
        self._step(first_request(time.monotonic_ns()), is_first=True)
        self._idle()
        self._parent.ready()
        request: SolveRequest | None = None
        while True:
            self._parent.allow(IDLE_S)
            wait_s = 0.0 if request is not None else CHANGING_S if self._parts.is_changing else LOOK_S
            messages = self._parent.receive(wait_s)
            orders = [message for message in messages if not isinstance(message, SolveRequest)]
            request = next((m for m in reversed(messages) if isinstance(m, SolveRequest)), request)
            if orders or self._parts.is_changing:
                self._turn(orders)
            if request is None or not self._slots.has_room():
                self._publish_live()
                continue
            self._step(request)
            request = None

    def _turn(self, orders: list[Order]) -> None:
        self._parent.allow(LIMITS.load_s)  # because an order may load content
        if orders:
            self._parent.send(Busy(time.monotonic_ns(), None))
        answers = self._parts.turn(orders)
        for answer in answers:
            self._parent.send(answer)
        first = self._parts.first_costs(time_ns=time.monotonic_ns())
        if first != self._costs.first:  # the model was replaced, so its rasters and costs may differ
            self._costs = CostBook(first)
        if orders or answers:
            self._idle()

    def _step(self, request: SolveRequest, *, is_first: bool = False) -> None:
        begun_ns = time.monotonic_ns()
        if not is_first:
            self._parent.allow(self._step_s)
            self._parent.send(Busy(begun_ns, request.effort))
        update = self._parts.step(request)
        took_ns = time.monotonic_ns() - begun_ns
        solution = update.solution
        if solution is not None and solution.effort is not None:
            stages = solution.stage_ms
            rest_ms = max(took_ns / NS_PER_MS - sum(stages.get(stage, 0.0) for stage in SOLVING_STAGES), 0.0)
            people = max(len(solution.people), 1)
            self._costs.learn(solution.effort, stages_for({**stages, REST: rest_ms}, people=1 / people))
        self._live = self._parts.live(time.monotonic_ns())
        bare = SolverUpdate(_bare(solution), _bare(update.flat), update.missing)
        places = self._handed_over(solution), self._handed_over(update.flat)
        info = self._parts.solver.state.content.info
        self._parent.send(Stepped(bare, *places, 0 if is_first else took_ns, self._costs.costs(), self._live, info))

    def _handed_over(self, solution: Solution | None) -> Slot | None:
        place = None if solution is None else self._slots.hand_over(solution.layers)
        return None if place is None else Slot(*place)

    def _idle(self) -> None:
        self._live = self._parts.live(time.monotonic_ns())
        self._parent.send(Idle(self._costs.costs(), self._live, self._parts.facts, self._costs.first))

    def _publish_live(self) -> None:
        if self._parts.live(time.monotonic_ns()) != self._live:
            self._idle()


def _bare(solution: Solution | None) -> Solution | None:
    return None if solution is None else replace(solution, layers=NO_LAYERS)
