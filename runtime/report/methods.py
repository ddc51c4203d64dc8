"""The methods that the frontier compares, each as a function from a pair to layers. Picklable: they run elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from runtime.records import U8
from runtime.report.pairs import StillPair

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
    trained: bool = True  # where not, time and memory are the network's, its picture is nobody's


@dataclass(frozen=True, slots=True)
class Opened:
    """A method made ready for a stack: what is done once and not timed."""

    solve: Callable[[StillPair], U8]  # layers (N, h, w, 3 or 4), the solver's own until its next call
    parameters: int
    precision: str


def opened(method: Method, pair: StillPair, *, threads: int) -> Opened:
    """A method ready for pairs on this pair's stack. Raises InputError, MissingPart."""
    from runtime.config import ModelSettings
    from runtime.model.predictor import Predictor, load_predictor
    from runtime.model.sart import SartPredictor
    from runtime.model.still import solve_still

    predictor: Predictor
    if method.iterations:
        predictor = SartPredictor(pair.stack, iterations=method.iterations)
    else:
        predictor = load_predictor(method.source, pair.stack, ModelSettings(threads=threads))
    session = getattr(predictor, "session", None)
    return Opened(
        lambda p: solve_still(*p.images, eyes_m=p.eyes_m, fov_deg=p.fov_deg, predictor=predictor).layers,
        predictor.parameters,
        "fp32" if session is None else str(session.contract.precision),
    )


def shipped_and_references(models: Sequence[str] = (), *, quick: bool = False) -> list[Method]:
    """The shipped sizes, further ONNX files, and the iterative reference. `quick` leaves out the slowest."""
    methods = [Method(name, "network", name) for name in SHIPPED]
    methods += [Method(Path(name).stem, "network", name) for name in models]
    return methods + [Method(f"SART-{n}", "iterative", "sart", n) for n in (SART[:-1] if quick else SART)]
