"""Interface of the devices (`cpu` and `gl`), which implement the operations of the solver."""

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
    """Panels of one stack on one device, which are kept between frames. Only one thread may use a state."""

    def begin(self, job: Job, geometry: Geometry, *, resumed: bool = False) -> AbstractContextManager[None]:
        """Load the targets of a job. All other methods must be called within the returned context.

        All pixels of the panels' boxes have the rest value until a panel is set.

        Args:
            resumed: Keep the panels and the momentum of the previous solution, which must have had the same geometry.
        """

    def set_panel(self, panel: int, codes: I16) -> None:
        """Set the box of a panel to (rows, columns[, 3]) values in sixteenths of an 8-bit code."""

    def close_middle(self) -> None:
        """Solve the middle panel for both eyes and leave the other panels as they are."""

    def start(self) -> None:
        """Prepare for steps that start from the current values of the panels, without momentum."""

    def step(self, step: Step) -> None:
        """Update all panels once (docs/mathematics.md, L5)."""

    def write(self, buffer: LayerBuffer, outside: int | tuple[int, ...] | None) -> None:
        """Write all panels to a buffer as 8-bit codes.

        Args:
            outside: Contents of the middle panel outside its box: a panel code, or a colour that the eyes should see.
                The outer panels have the rest code outside their boxes. If None, the buffer's contents outside the
                boxes are kept.
        """

    def close(self) -> None:
        """Release textures. The method may be called more than once."""


class SolverBackend(Protocol):
    """Device that runs the solver's steps."""

    name: str  # value of the setting `model.backend` that selects this device
    context: object  # OpenGL context whose textures the device can read; None: it can only read arrays

    def state(self, stack: PanelStack, *, threads: int) -> SolverState:
        """Create the state for a stack. Raises InputError if a panel is too large for the device."""

    def close(self) -> None:
        """Release the resources that the states share.

        All states must be closed before. The method may be called more than once.
        """
