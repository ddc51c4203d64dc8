"""The methods that the frontier compares. Picklable: they run in processes of their own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from runtime.model.predictor import Predictor
    from runtime.optics.stack import PanelStack

Kind = Literal["network", "iterative"]
SHIPPED = ("balanced", "fast", "best")  # the default first: a report's first figure
SART = (1, 3, 10, 30)


@dataclass(frozen=True, slots=True)
class Method:
    """A way to layers."""

    name: str
    kind: Kind
    source: str  # what `load_predictor` takes
    iterations: int = 0  # of SART

    def opened(self, stack: PanelStack, *, threads: int) -> Predictor:
        """Ready for pairs on a stack. Raises InputError, MissingPart."""
        from runtime.config import ModelSettings
        from runtime.model.predictor import load_predictor
        from runtime.model.sart import SartPredictor

        if self.iterations:
            return SartPredictor(stack, iterations=self.iterations)
        return load_predictor(self.source, stack, ModelSettings(threads=threads))


def shipped_and_references(models: Sequence[str] = (), *, quick: bool = False) -> list[Method]:
    """The shipped sizes, further ONNX files, and the iterative reference. `quick` leaves out the slowest."""
    methods = [Method(name, "network", name) for name in SHIPPED]
    methods += [Method(Path(name).stem, "network", name) for name in models]
    return methods + [Method(f"SART-{n}", "iterative", "sart", n) for n in (SART[:-1] if quick else SART)]
