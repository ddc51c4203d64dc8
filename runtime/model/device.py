"""What a device (`cpu`, `gl`) does for the solver: single steps, of whose order it knows nothing."""

from __future__ import annotations

from contextlib import AbstractContextManager
from typing import Protocol

from runtime.model.contract import Step
from runtime.model.geometry import Geometry
from runtime.model.job import Job
from runtime.optics.stack import PanelStack
from runtime.records import I16, Layers


class SolverState(Protocol):
    """The panels of one stack on one device, kept from frame to frame. One thread uses it."""

    def begin(self, job: Job, geometry: Geometry) -> AbstractContextManager[None]:
        """Take the targets; panels rest in their boxes until set. All else is done within what it answers."""

    def set_panel(self, panel: int, codes: I16) -> None:
        """What a panel shows within its box: (rows, columns[, 3]), sixteenths of a code."""

    def close_middle(self) -> None:
        """The middle panel as it is best for both eyes, while the others stay."""

    def start(self) -> None:
        """Begin steps where the panels are: without momentum."""

    def step(self, step: Step) -> None:
        """Move all panels."""

    def write(self, beside: int | tuple[int, ...] | None) -> Layers:
        """(N, h, w, 4) 8-bit codes of all panels, valid until the next frame.

        Outside the boxes panels rest; the middle one has a code or a colour, or with None keeps its pixels.
        """

    def close(self) -> None:
        """Release textures. May be called twice."""


class SolverBackend(Protocol):
    """A device that does the steps."""

    name: str  # as `model.backend` calls it
    context: object  # of OpenGL, whose textures it reads; None: it reads arrays

    def state(self, stack: PanelStack, *, threads: int) -> SolverState:
        """For a stack. Raises InputError where that does not fit."""

    def close(self) -> None:
        """Release what its states shared, once they are closed. May be called twice."""
