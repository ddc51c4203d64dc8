"""OpenGL as a backend: one context, whose programs all models on it share."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

from runtime.model.gl.programs import Passes
from runtime.model.gl.state import GlState, check_size
from runtime.optics.stack import PanelStack
from runtime.support.gl import describe


class GlBackend:
    """Used on one thread, on which its context is current."""

    name = "gl"

    def __init__(self, context: Any, stack: PanelStack) -> None:
        """context: the content's, or one of the backend's own; whoever made it releases it. Raises InputError where a
        panel of the stack is too large for the driver."""
        check_size(context, stack)
        self.context = context
        self.passes = Passes(context)
        self.renderer = describe(context)["renderer"]

    def state(self, stack: PanelStack, *, threads: int) -> GlState:
        return GlState(self.passes, stack)

    def close(self) -> None:
        with suppress(Exception):  # of a context that is lost there is nothing to release
            self.passes.release()
