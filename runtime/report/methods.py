"""The methods that the frontier compares, each as a function from a pair to layers. Picklable: they run elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from runtime.records import U8
from runtime.report.pairs import StillPair

Kind = Literal["network", "iterative", "closed form"]
Solver = Callable[[StillPair], U8]  # layers (N, h, w, 3 or 4), the solver's own until its next call


@dataclass(frozen=True, slots=True)
class Method:
    """A way to layers."""

    name: str
    kind: Kind
    source: str  # `cg`, `filter`, `mean`, `sart`, or what `load_predictor` takes
    iterations: int = 0
    tolerance_mm: float | None = None  # of the networks; None: the default


@dataclass(frozen=True, slots=True)
class Opened:
    """A method made ready for a stack: what is done once and not timed."""

    solve: Solver
    parameters: int
    precision: str


def opened(method: Method, pair: StillPair, *, threads: int) -> Opened:
    """A method ready for pairs on this pair's stack. Raises InputError, MissingPart."""
    if method.source == "cg":
        return Opened(lambda p: _conjugate_gradients(p, method.iterations), 0, "fp32")
    if method.source == "mean":
        return Opened(_mean, 0, "fp32")
    if method.source == "filter":
        return Opened(lambda p: _filter(p, method.iterations), 0, "fp32")
    from runtime.config import ModelSettings
    from runtime.model.predictor import Predictor, load_predictor
    from runtime.model.still import solve_still

    settings = ModelSettings(threads=threads)
    if method.tolerance_mm is not None:
        settings = settings.model_copy(update={"tolerance_mm": method.tolerance_mm})
    if method.source == "sart":
        from runtime.model.sart import SartPredictor

        predictor: Predictor = SartPredictor(pair.stack, iterations=method.iterations)
        precision = "fp32"
    else:
        predictor = load_predictor(method.source, pair.stack, settings)
        session = getattr(predictor, "session", None)
        precision = session.contract.precision if session is not None else "fp32"
    return Opened(
        lambda p: solve_still(p.images[0], p.images[1], eyes_m=p.eyes_m, fov_deg=p.fov_deg, predictor=predictor).layers,
        predictor.parameters,
        precision,
    )


def _wanted(pair: StillPair) -> list[np.ndarray]:
    return [image.astype(np.float32) / np.float32(255) for image in pair.images]


def _conjugate_gradients(pair: StillPair, iterations: int) -> U8:
    from runtime.report.baselines import as_codes, conjugate_gradients, eye_operator

    height, width = pair.images[0].shape[:2]
    operators = [
        eye_operator(eye, pair.stack, width_px=width, height_px=height, fov_deg=pair.fov_deg) for eye in pair.eyes_m
    ]
    return as_codes(conjugate_gradients(operators, _wanted(pair), pair.stack, iterations=iterations))


def _mean(pair: StillPair) -> U8:
    from runtime.report.baselines import as_codes, mean_of_targets

    return as_codes(mean_of_targets(pair.eyes_m, _wanted(pair), pair.stack, fov_deg=pair.fov_deg))


def _filter(pair: StillPair, steps: int) -> U8:
    from runtime.report.baselines import as_codes
    from runtime.report.filters import filtered_layers

    return as_codes(filtered_layers(pair.eyes_m, _wanted(pair), pair.stack, fov_deg=pair.fov_deg, steps=steps))


def shipped_and_references(*, models: Sequence[str] = (), quick: bool = False) -> list[Method]:
    """Our sizes, further ONNX files, and the reference methods; `quick` leaves out the slowest."""
    methods = [Method(name, "network", name) for name in ("fast", "balanced", "best")]
    methods += [Method(Path(name).stem, "network", name) for name in models]
    methods += [Method(f"SART-{n}", "iterative", "sart", n) for n in ((1, 3, 10) if quick else (1, 3, 10, 30))]
    methods += [Method(f"CG-{n}", "iterative", "cg", n) for n in ((3, 10) if quick else (3, 10, 30))]
    methods += [Method(f"filter-{n}", "closed form", "filter", n) for n in (1, 3)]
    methods.append(Method("mean of targets", "closed form", "mean"))
    return methods
