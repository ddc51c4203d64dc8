"""Save every N-th refresh's layers and target pictures to files (`--keep-light`)."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, Protocol

import numpy as np

from runtime.evaluation.refresh_quality import Pictures, RefreshTargets, solved_eyes_of, true_eyes_of
from runtime.frame.refresh import Refresh
from runtime.frame.targets import TargetDrawer
from runtime.frame.truth import TrueEyes
from runtime.optics.presentation import shown_layers
from runtime.records import F64, U8, RefreshAccount
from runtime.support import progress
from runtime.support.background import BackgroundJob

log = logging.getLogger("phasestack.light")

LOOK_S = 0.01  # interval between checks for drawn pictures and for a stop request
WRITTEN_WITHIN_S = 10.0  # timeout for writing the layers of the last saved refresh


class Output(Protocol):
    """Destination for a run's output files."""

    def refresh(self, line: dict[str, Any]) -> None:
        """Append a line to frames.jsonl."""

    def light(self, frame: int, *, layers: U8) -> None:
        """Write the RGBA layers (N, h, w, 4) shown by the panels at one refresh."""

    def light_targets(self, frame: int, *, info: dict[str, Any], drawn: Pictures | None, true: Pictures | None) -> None:
        """Write the target pictures for the eyes solved for and the true eyes of a refresh with saved layers."""


@dataclass(frozen=True, slots=True)
class _Kept:
    account: RefreshAccount
    solved_for_ns: int
    scene: int  # the run's scene at this refresh


class KeptLight:
    """Writes every `every`-th refresh's layers and target pictures, or none if it is 0."""

    def __init__(self, every: int, output: Output, drawer: TargetDrawer, truth: TrueEyes, *, simulated: bool) -> None:
        self._every, self._output, self._drawer, self._truth = every, output, drawer, truth
        self._simulated = simulated
        self._job: BackgroundJob[None] | None = None
        self._kept: list[_Kept] = []

    def refreshed(self, refresh: Refresh) -> None:
        """Write this refresh's layers if due; in real time, by a background job, and not while it is running."""
        account = refresh.account
        if not self._every or account.frame % self._every != self._every - 1 or not account.presented:
            return
        if self._job is not None and not self._job.done:
            return

        def keep() -> None:
            self._output.light(account.frame, layers=shown_layers(refresh.frame))

        if self._simulated:
            keep()
        else:
            self._job = BackgroundJob("kept light", keep)
        solved_for_ns = refresh.solution.solved_for_ns if refresh.solution is not None else 0
        kept = _Kept(account, solved_for_ns, self._drawer.scene)
        if self._truth.is_recorded:
            self._kept.append(kept)
        else:  # a live run is ended by a signal, so there is no time to draw afterwards
            self._draw(kept, lambda: None)

    def finish(self, stopped: Callable[[], bool]) -> None:
        """When playing a recording, draw the target pictures for all saved refreshes, until `stopped`."""
        if self._job is not None:
            self._job.wait(WRITTEN_WITHIN_S)
        total = len(self._kept)
        for done, kept in enumerate(self._kept):
            progress.tell("drawing target pictures", done, total)
            drawn: list[None] = []
            if not stopped():
                self._draw(kept, partial(drawn.append, None))
            while not drawn and not stopped():
                time.sleep(LOOK_S)
                self._drawer.look()
            if not drawn:
                log.warning(
                    "stopped early, so %d of %d refreshes kept by --keep-light have no target pictures",
                    total - done,
                    total,
                )
                for rest in self._kept[done:]:
                    self._write(rest, RefreshTargets(self._drawer.fov_deg))
                return

    def _draw(self, kept: _Kept, then: Callable[[], None]) -> None:
        account = self._truth.of(kept.account)
        wanted: dict[str, tuple[F64, int]] = {}
        eyes, true = solved_eyes_of(account), [*true_eyes_of(account).values()]
        solved_for_m = account.solved_for_m if eyes is None else eyes[0]
        if solved_for_m is not None:
            wanted["solved"] = solved_for_m, kept.solved_for_ns
        if true:
            wanted["true"] = np.concatenate(true), account.photon_ns

        def write(targets: RefreshTargets | None) -> None:
            self._write(kept, targets or RefreshTargets(self._drawer.fov_deg))
            then()

        self._drawer.draw(wanted, kept.scene, write)

    def _write(self, kept: _Kept, targets: RefreshTargets) -> None:
        account = self._truth.of(kept.account)
        info = {
            "solved_for_m": account.solved_for_m,
            "eyes_m": account.eyes_m,
            "true_eyes_m": account.true_eyes_m,
            "fov": targets.fov_deg,
            "people": [asdict(person) for person in account.people],
        }
        self._output.light_targets(account.frame, info=info, drawn=targets.solved, true=targets.true)
