"""Interface of a device (`cpu` or `gl`): the operations that make up a solution."""

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
    """The panels of one stack on one device, kept between frames. Only one thread uses it."""

    def begin(self, job: Job, geometry: Geometry, *, resumed: bool = False) -> AbstractContextManager[None]:
        """Load the targets. All other methods must be called within the returned context.

        Panels are at rest in their boxes until they are set. resumed: keep the panels and momentum of the previous
        solution, which must have had the same geometry.
        """

    def set_panel(self, panel: int, codes: I16) -> None:
        """Set a panel's box to codes (rows, columns[, 3]), in sixteenths of an 8-bit code."""

    def close_middle(self) -> None:
        """Solve the middle panel for both eyes and leave the other panels as they are."""

    def start(self) -> None:
        """Prepare for steps from the panels' present values, without momentum."""

    def step(self, step: Step) -> None:
        """Update all panels once."""

    def write(self, buffer: LayerBuffer, outside: int | tuple[int, ...] | None) -> None:
        """Write all panels to a buffer as 8-bit codes.

        outside: code or colour of the middle panel outside its box; the outer panels get the rest code there. With
        None, the buffer's contents outside the boxes are kept.
        """

    def close(self) -> None:
        """Release textures. May be called twice."""


class SolverBackend(Protocol):
    """A device that runs the solver's steps."""

    name: str  # value of `model.backend` that selects it
    context: object  # OpenGL context whose textures it reads; None: it reads arrays

    def state(self, stack: PanelStack, *, threads: int) -> SolverState:
        """Create the state for a stack. Raises InputError if the device does not support its size."""

    def close(self) -> None:
        """Release what the states share, after all of them are closed. May be called twice."""
