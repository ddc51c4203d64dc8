"""OpenGL as a backend: one context, whose programs all models on it share."""

from __future__ import annotations

from typing import Any

from runtime.model.contract import Contract
from runtime.model.gl.programs import Passes
from runtime.model.gl.surround import GlSurround, check_size
from runtime.optics.stack import PanelStack
from runtime.support.gl import describe


class GlBackend:
    """Used on one thread, on which its context is current."""

    name = "gl"

    def __init__(self, context: Any, stack: PanelStack) -> None:
        """context: the content's, or one of the backend's own; whoever made it releases it. Raises InputError where
        a panel of the stack is too large for the driver."""
        check_size(context, stack)
        self.context = context
        self.at_once = False  # corrections in one pass: found by trying (`backends`)
        self.passes = Passes(context)
        self.renderer = describe(context)["renderer"]

    def surround(self, contract: Contract, stack: PanelStack, *, threads: int) -> GlSurround:
        return GlSurround(self.passes, contract, stack, at_once=self.at_once)
