"""Compare refreshes with their target pictures, in a separate process if the run is in real time.

A thread of the presenter's process would hold Python's lock while other work keeps it off the processors, and the
presenter would wait for it.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace
from typing import Any

from runtime.evaluation.refresh_quality import RefreshQuality, RefreshTargets, measure_refresh
from runtime.optics.presentation import shown_layers
from runtime.optics.stack import PanelStack
from runtime.records import PanelFrame, RefreshAccount
from runtime.support.background import BACKGROUND_NICENESS
from runtime.support.process import Ended, Parent, Role, Worker
from runtime.support.untrusted_input import LIMITS, MIB

WITHIN_S = 60.0  # limit for one comparison
IDLE_S = 60.0  # interval for renewing the time limit while there is nothing to do
LOOK_S = 0.05  # interval for checking whether the run has ended
MEMORY_BYTES = 2048 * MIB


@dataclass(frozen=True, slots=True)
class Comparison:
    """A refresh and what it is compared with."""

    account: RefreshAccount
    frame: PanelFrame
    targets: RefreshTargets
    for_page: bool  # measure only what a live page shows
    state_version: int  # the solver's state at the refresh (`Facts.version`)


def compared(job: Comparison, stack: PanelStack) -> RefreshQuality:
    """Measure a refresh's quality."""
    frame, carried = job.frame, None
    if job.targets.used is not None:
        aligned = replace(frame, parallax=None)
        carried = shown_layers(aligned), shown_layers(replace(aligned, solved_from_shown=()))
    quality = measure_refresh(job.account, shown_layers(frame), carried, job.targets, stack, for_page=job.for_page)
    if quality.moment is None:
        return quality
    moment = replace(quality.moment, relief=frame.relief, account=job.account, state_version=job.state_version)
    return replace(quality, moment=moment)


class MeasuringProcess:
    """Process that measures one refresh at a time. It begins with the first one, if not before."""

    def __init__(self, stack: PanelStack) -> None:
        self._stack = stack
        self._worker: Worker | None = None
        self._closing = threading.Event()

    def begin(self) -> Worker:
        """Start the process, and return it. Raises TransientError if the system cannot."""
        self._worker = self._worker or Worker(ROLE, lambda: (self._stack,))
        return self._worker

    def status(self) -> list[dict[str, Any]]:
        """Return the process and its resources, for the status. Empty if it has not begun."""
        return [] if self._worker is None else [self._worker.status()]

    def compared(self, job: Comparison) -> RefreshQuality | None:
        """Measure a refresh's quality, and wait for it. For one thread at a time. Returns None if the process
        has ended or the run ends. Raises PhasestackError if the process cannot be started.
        """
        if job.frame.flatness == 0.0:
            job = replace(job, frame=replace(job.frame, flat=None))
        worker = self.begin()
        worker.wait_ready(lambda: not self._closing.is_set())
        worker.receive()  # what an earlier process has left
        if not worker.send(job):
            return None
        while not self._closing.is_set():
            for message in worker.receive(LOOK_S):
                if isinstance(message, RefreshQuality):
                    return message
                if isinstance(message, Ended):
                    return None
        return None

    def close(self) -> None:
        """End the process. May be called more than once."""
        self._closing.set()
        if self._worker is not None:
            self._worker.close()


def serve(parent: Parent, stack: PanelStack) -> None:
    """Measure refreshes until the parent closes the channel. Main function of the measuring process."""
    parent.ready()
    while True:
        parent.allow(IDLE_S + WITHIN_S)
        for job in parent.receive(IDLE_S):
            parent.allow(WITHIN_S)
            parent.send(compared(job, stack))


ROLE = Role(
    "measurement",
    serve,
    niceness=BACKGROUND_NICENESS,
    memory_bytes=MEMORY_BYTES,
    oom_score=1000,
    start_s=LIMITS.start_s,
)
