"""Interface for the devices (`cpu` and `gl`), which implement the solver's operations."""

from __future__ import annotations

from contextlib import AbstractContextManager
from typing import Protocol

from runtime.model.buffers import LayerBuffer
from runtime.model.contract import Step
from runtime.model.geometry import Geometry
from runtime.model.job import Job
from runtime.optics.stack import PanelStack
from runtime.records import I16


class OpenSolution(Protocol):
    """One solution that is being computed on a device, for use only within its `SolverState.begin`."""

    def set_panel(self, panel: int, codes: I16) -> None:
        """Set a panel's box to (rows, columns[, 3]) values in sixteenths of an 8-bit code."""

    def panel(self, panel: int) -> I16:
        """Return a panel's box as (rows, columns, channels) values in sixteenths of an 8-bit code."""

    def close_middle(self) -> None:
        """Solve the middle panel for all views, leaving the other panels as they are."""

    def start(self) -> None:
        """Prepare for steps that start from the panels' current values, without momentum."""

    def step(self, step: Step) -> None:
        """Update all panels once (docs/mathematics.md, L5)."""

    def write(self, buffer: LayerBuffer, outside: int | tuple[int, ...] | None) -> None:
        """Write all panels to a buffer as 8-bit codes. If `outside` is None, it keeps its contents outside
        the boxes. Otherwise, `outside` is a middle-panel code, or a colour that the eyes should see there; the outer
        panels rest.
        """


class SolverState(Protocol):
    """One stack's panels on one device, kept between frames. A state may be used by only one thread."""

    def begin(self, job: Job, geometry: Geometry, *, resumed: bool = False) -> AbstractContextManager[OpenSolution]:
        """Load a job's targets, and begin a solution. Until a panel is set, its box has the rest value.
        If `resumed`, the panels and the momentum of the previous solution are kept, which must have had the same
        geometry.
        """

    def close(self) -> None:
        """Release textures. May be called more than once."""


class SolverBackend(Protocol):
    """Device that runs the solver's steps."""

    name: str  # value of the `model.backend` setting that selects this device
    context: object  # OpenGL context whose textures the device can read; None: it reads only arrays

    def state(self, stack: PanelStack, *, threads: int) -> SolverState:
        """Create the state for a stack. Raises InputError if the panels are too large for the device."""

    def close(self) -> None:
        """Release the states' common resources, once these are closed. May be called more than once."""
