"""Light against run time of every method on every pair, with each method in a separate process."""

from __future__ import annotations

import contextlib
import math
import os
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field, replace
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, ParamSpec, TypeVar

import numpy as np

from runtime.errors import FatalError, PhasestackError
from runtime.evaluation.solved import PairQuality, SolvedPair
from runtime.evaluation.trials import timed
from runtime.optics.carried import intensities
from runtime.optics.light import ONE_RAY, squared_errors
from runtime.optics.quality import psnr_db
from runtime.records import U8
from runtime.report.pairs import StillPair
from runtime.support.artifacts import write_text

if TYPE_CHECKING:
    from runtime.model.predictor import Predictor
    from runtime.optics.stack import PanelStack

P = ParamSpec("P")
T = TypeVar("T")
Kind = Literal["network", "iterative"]
SHIPPED = ("balanced", "fast", "best")  # the default model comes first in a report
SART = (1, 3, 10, 30)
ENOUGH_S = 2.0  # seconds of timed runs per pair; slow methods run once
MOST_RUNS = 25  # maximum number of timed runs of one method on one pair
FEWEST_RUNS = 3  # minimum number of timed runs, unless the first is slow
SLOW_S = 4.0  # if the first run takes longer than this, it counts and is the only one
OFF_STEP = 3  # for displaced eyes, every third ray of every third row is enough
QUOTED = "1"  # key of `light_db`: tracking error 1 mm


@dataclass(frozen=True, slots=True)
class Method:
    """Method that computes layers."""

    name: str
    kind: Kind
    source: str  # argument of `load_predictor`
    iterations: int = 0  # iterations of SART

    def opened(self, stack: PanelStack, *, threads: int) -> Predictor:
        """Load a predictor for a stack. Raises InputError, MissingPart."""
        from runtime.config import ModelSettings
        from runtime.model.predictor import load_predictor
        from runtime.model.sart import SartPredictor

        if self.iterations:
            return SartPredictor(stack, iterations=self.iterations)
        return load_predictor(self.source, stack, ModelSettings(threads=threads))


def shipped_and_references(models: Sequence[str] = (), *, quick: bool = False) -> list[Method]:
    """Return the shipped models, further ONNX files and the iterative reference. quick: omit the slowest."""
    methods = [Method(name, "network", name) for name in SHIPPED]
    methods += [Method(Path(name).stem, "network", name) for name in models]
    return methods + [Method(f"SART-{n}", "iterative", "sart", n) for n in (SART[:-1] if quick else SART)]


@dataclass(frozen=True, slots=True)
class MethodRun:
    """Measurements of one method on one pair, in a separate process."""

    layers: U8
    run_ms: tuple[float, ...]  # times of whole solutions, from two decoded images to N 8-bit layers
    memory_mib: float  # peak memory of the process
    parameters: int
    precision: str


@dataclass(frozen=True, slots=True)
class PairResult:
    """Quality of one method on one pair."""

    pair: str
    run_ms: tuple[float, ...]
    memory_mib: float
    quality: PairQuality
    psnr_db_off_eye: dict[str, float]
    viewer: str = ""  # file name of the viewer of its layers, if written


@dataclass(frozen=True, slots=True)
class MethodResult:
    """Means of a method over the pairs of one resolution: an entry of `methods` in report.json."""

    name: str
    kind: Kind
    precision: str
    width_px: int
    height_px: int
    ms_p50: float
    ms_p99: float
    memory_mib: float
    parameters: int
    light_db: dict[str, float]  # by tracking error, millimetres: "0", "1", "2"
    expected_db: dict[str, float]  # the same with one ray per pixel
    psnr_db: float
    ssim: float
    worst_eye_psnr_db: float  # worst of all eyes and pairs
    psnr_db_off_eye: dict[str, float]
    pairs: list[PairResult] = field(default_factory=list)

    @property
    def spread_ms(self) -> tuple[float, float]:
        """10th and 90th percentiles of run times, relative to each pair's median, times `ms_p50`."""
        ratios = np.concatenate([np.asarray(pair.run_ms) / np.median(pair.run_ms) for pair in self.pairs])
        low, high = np.percentile(ratios, (10, 90))
        return float(low) * self.ms_p50, float(high) * self.ms_p50

    @property
    def quoted_db(self) -> float:
        """Figure to quote, or NaN if displaced eyes see no part of the panels."""
        return self.light_db.get(QUOTED, math.nan)


def measure(
    methods: Sequence[Method], pairs: Iterable[StillPair], *, threads: int = 2, viewers: Path | None = None
) -> Iterator[tuple[str, MethodResult]]:
    """Measure every method, pair by pair, at one resolution.

    viewers: folder for viewers of the first method. After each measurement, yields its name and the result of the
    method so far. Raises FatalError if one fails.
    """
    results: dict[str, list[PairResult]] = {method.name: [] for method in methods}
    for pair in pairs:
        for method in methods:
            run = apart(run_method, method, replace(pair, off=()), threads)
            viewer = viewers if method is methods[0] else None
            results[method.name].append(pair_result(pair, run, viewer=viewer))
            yield f"{method.name}, {pair.name}", _together(method, pair, run, results[method.name])


def apart(function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """Call an importable function in a new process. Raises FatalError if the process dies."""
    # Its stdout goes to stderr, because ours may be JSON.
    with ProcessPoolExecutor(1, get_context("spawn"), initializer=os.dup2, initargs=(2, 1)) as pool:
        try:
            return pool.submit(_called, function, args, kwargs).result()
        except BrokenProcessPool:
            raise FatalError(f"{function.__name__}: the measuring process died unexpectedly") from None


def _called(function: Callable[..., T], args: Any, kwargs: Any) -> T:
    try:
        return function(*args, **kwargs)
    except PhasestackError as error:  # not every error class can be pickled
        raise FatalError(str(error)) from None


def run_method(method: Method, pair: StillPair, threads: int) -> MethodRun:
    """Load, warm up and time a method, and record its peak memory. Runs in a separate process."""
    import cv2

    from runtime.model.still import solve_still

    cv2.setNumThreads(threads)
    predictor = method.opened(pair.stack, threads=threads)
    with contextlib.suppress(OSError):  # on older kernels the peak includes the interpreter's start, which needs less
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    done = timed(
        lambda: solve_still(*pair.images, eyes_m=pair.eyes_m, fov_deg=pair.fov_deg, predictor=predictor).layers,
        runs=FEWEST_RUNS,
        most=MOST_RUNS,
        enough_s=ENOUGH_S,
        slow_s=SLOW_S,
    )
    layers, peak_mib = np.array(done.answer[..., :3]), _peak_mib()
    return MethodRun(layers, done.times_ms, peak_mib, predictor.parameters, predictor.precision)


def _peak_mib() -> float:
    status = Path("/proc/self/status").read_text(encoding="ascii")
    return int(status.partition("VmHWM:")[2].split()[0]) / 1024


def pair_result(pair: StillPair, run: MethodRun, *, viewer: Path | None = None) -> PairResult:
    """Measure quality (docs/contracts.md, Error) at the eyes, expected, and at displaced eyes.

    viewer: folder for a viewer of the layers.
    """
    at_eyes = SolvedPair(run.layers, pair.images, pair.stack, pair.eyes_m, pair.fov_deg)
    off: dict[str, list[float]] = {}
    sampling = ONE_RAY._replace(step=OFF_STEP)
    for view in pair.off:
        place = view.eye_m[None]
        where: Any = {"solved_for_m": place, "eyes_m": place, "fov_deg": pair.fov_deg, "sampling": sampling}
        with contextlib.suppress(ValueError):  # raised if that eye sees no part of the panels
            errors = squared_errors(run.layers, [intensities(view.image)], pair.stack, **where)
            off.setdefault(f"{view.mm:g}mm", []).append(psnr_db(errors[0]))
    beside = {name: float(np.mean(values)) for name, values in off.items()}
    name = ""
    if viewer is not None:
        name = f"viewer-{re.sub(r'[^A-Za-z0-9]+', '-', pair.name)}.html"
        write_text(viewer / name, at_eyes.viewer([pair.name]))
    return PairResult(pair.name, run.run_ms, run.memory_mib, at_eyes.quality, beside, name)


def _together(method: Method, pair: StillPair, run: MethodRun, pairs: list[PairResult]) -> MethodResult:
    all_ms = np.concatenate([one.run_ms for one in pairs])
    seen = [one.quality for one in pairs]
    return MethodResult(
        name=method.name,
        kind=method.kind,
        precision=run.precision,
        width_px=pair.stack.width_px,
        height_px=pair.stack.height_px,
        ms_p50=float(np.median(all_ms)),
        ms_p99=float(np.percentile(all_ms, 99)),
        memory_mib=max(one.memory_mib for one in pairs),
        parameters=run.parameters,
        light_db=_means([one.light_db for one in seen]),
        expected_db=_means([one.expected_db for one in seen]),
        psnr_db=float(np.mean([one.psnr_db for one in seen])),
        ssim=float(np.mean([one.ssim for one in seen])),
        worst_eye_psnr_db=min(min(one.eye_psnr_db) for one in seen),
        psnr_db_off_eye=_means([one.psnr_db_off_eye for one in pairs]),
        pairs=list(pairs),
    )


def _means(tables: Sequence[Any]) -> dict[str, float]:
    """Return the mean for each key over the tables that have a finite value for it."""
    keys = dict.fromkeys(key for table in tables for key in table)
    values_of = {key: [table[key] for table in tables if math.isfinite(table.get(key, math.nan))] for key in keys}
    return {key: float(np.mean(values)) for key, values in values_of.items() if values}
