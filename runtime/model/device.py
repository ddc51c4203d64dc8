"""Interface of a device (`cpu`, `gl`): the solver's single operations. Their order is the solver's business."""

from __future__ import annotations

from contextlib import AbstractContextManager
from typing import Protocol

from runtime.model.buffers import LayerBuffer
from runtime.model.contract import Step
from runtime.model.geometry import Geometry
from runtime.model.job import Job
from runtime.optics.stack import PanelStack
from runtime.records import I16


class SolverState(Protocol):
    """The panels of one stack on one device, kept from frame to frame. One thread uses it."""

    def begin(self, job: Job, geometry: Geometry, *, resumed: bool = False) -> AbstractContextManager[None]:
        """Load the targets; everything else is called within the returned context.

        Panels rest in their boxes until they are set. resumed: they and their momentum are those of the solution
        before, whose geometry was the same.
        """

    def set_panel(self, panel: int, codes: I16) -> None:
        """Set a panel's box: (rows, columns[, 3]), sixteenths of a code."""

    def close_middle(self) -> None:
        """Solve the middle panel for both eyes, with the other panels fixed."""

    def start(self) -> None:
        """Begin steps from the panels as they are, without momentum."""

    def step(self, step: Step) -> None:
        """Update all panels."""

    def write(self, buffer: LayerBuffer, outside: int | tuple[int, ...] | None) -> None:
        """Write all panels as 8-bit codes.

        Outside the boxes panels rest, and the middle one has a code or a colour; with None they keep the buffer's.
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
