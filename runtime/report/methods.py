"""The methods that the frontier compares, each as a function from a pair to layers. Picklable: they run elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from runtime.model.backends import Wanted
from runtime.optics.pupil import PUPIL_SIGMA_MM
from runtime.records import U8
from runtime.report.pairs import StillPair

if TYPE_CHECKING:
    from runtime.model.predictor import Predictor

Kind = Literal["network", "iterative", "closed form"]
SHIPPED = ("fast", "balanced", "best")
Solver = Callable[[StillPair], U8]  # layers (N, h, w, 3 or 4), the solver's own until its next call


@dataclass(frozen=True, slots=True)
class Method:
    """A way to layers."""

    name: str
    kind: Kind
    source: str  # `cg`, `filter`, `mean`, `sart`, or what `load_predictor` takes
    iterations: int = 0
    eye_sigma_mm: float = PUPIL_SIGMA_MM  # that networks solve for
    scale: float = 1.0  # a network works at this share of the panels' columns and rows; its layers are enlarged
    backend: Wanted = "opencv"  # what surrounds a network
    trained: bool = True  # where not, time and memory are the network's, its picture is nobody's


@dataclass(frozen=True, slots=True)
class Opened:
    """A method made ready for a stack: what is done once and not timed."""

    solve: Solver
    parameters: int
    precision: str
    multiply_adds: Callable[[StillPair], int]  # of one prediction


def opened(method: Method, pair: StillPair, *, threads: int) -> Opened:
    """A method ready for pairs on this pair's stack. Raises InputError, MissingPart."""
    if method.source in ("cg", "mean", "filter"):
        return _plain(method)
    from runtime.model.predictor import model_path
    from runtime.model.still import solve_still
    from runtime.report.operations import predictor_multiply_adds

    predictor = _predictor(method, pair, threads)
    return Opened(
        lambda p: (
            solve_still(
                p.images[0],
                p.images[1],
                eyes_m=p.eyes_m,
                fov_deg=p.fov_deg,
                predictor=predictor,
                eye_sigma_mm=method.eye_sigma_mm,
            ).layers
        ),
        predictor.parameters,
        _precision(predictor),
        lambda p: predictor_multiply_adds(predictor, p, path=model_path(method.source)),
    )


def _plain(method: Method) -> Opened:
    """The references that are plain linear algebra."""
    from runtime.report import operations

    n = method.iterations
    if method.source == "cg":
        return Opened(
            lambda p: _conjugate_gradients(p, n),
            0,
            "fp32",
            lambda p: operations.cg_multiply_adds(p.stack, rays=_rays(p), iterations=n),
        )
    if method.source == "mean":
        return Opened(_mean, 0, "fp32", lambda p: operations.mean_multiply_adds(p.stack))
    return Opened(lambda p: _filter(p, n), 0, "fp32", lambda p: operations.filter_multiply_adds(p.stack, steps=n))


def _predictor(method: Method, pair: StillPair, threads: int) -> Predictor:
    """Raises InputError, MissingPart."""
    from runtime.config import ModelSettings
    from runtime.model.backends import choose
    from runtime.model.predictor import load_predictor
    from runtime.plan.reduced import ReducedPredictor
    from runtime.support.gl import offscreen_context

    if method.source == "sart":
        from runtime.model.sart import SartPredictor

        return SartPredictor(pair.stack, iterations=method.iterations)
    settings = ModelSettings(threads=threads)
    if method.scale == 1.0:
        predictor = load_predictor(method.source, pair.stack, settings)
        if method.backend != "opencv":
            predictor.surround_with(choose(method.backend, predictor, offscreen_context).backend)
        return predictor
    small = replace(
        pair.stack,
        width_px=round(pair.stack.width_px * method.scale),
        height_px=round(pair.stack.height_px * method.scale),
    )
    return ReducedPredictor(load_predictor(method.source, small, settings), pair.stack)


def _precision(predictor: Predictor) -> str:
    session = getattr(getattr(predictor, "small", predictor), "session", None)
    return "fp32" if session is None else str(session.contract.precision)


def _wanted(pair: StillPair) -> list[np.ndarray]:
    return [image.astype(np.float32) / np.float32(255) for image in pair.images]


def _rays(pair: StillPair) -> int:
    from runtime.report.baselines import rays_that_count

    height, width = pair.images[0].shape[:2]
    size = {"width_px": width, "height_px": height, "fov_deg": pair.fov_deg}
    return sum(rays_that_count(eye, pair.stack, **size) for eye in pair.eyes_m)


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


def shipped_and_references(
    *, models: Sequence[str] = (), variants: Sequence[Method] = (), quick: bool = False
) -> list[Method]:
    """Our sizes, at half the panels' resolution too, further ONNX files, and the reference methods.

    variants: what is made for the occasion, such as other precisions. `quick` leaves out the slowest.
    """
    methods = [Method(name, "network", name) for name in SHIPPED]
    methods += [Method(f"{name} ×½", "network", name, scale=0.5) for name in SHIPPED]
    methods += [Method(Path(name).stem, "network", name) for name in models]
    methods += variants
    methods += [Method(f"SART-{n}", "iterative", "sart", n) for n in ((1, 3, 10) if quick else (1, 3, 10, 30))]
    methods += [Method(f"CG-{n}", "iterative", "cg", n) for n in ((3, 10) if quick else (3, 10, 30))]
    methods += [Method(f"filter-{n}", "closed form", "filter", n) for n in (1, 3)]
    methods.append(Method("mean of targets", "closed form", "mean"))
    return methods
