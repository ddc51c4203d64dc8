"""Measure every method's light PSNR and run time on every pair, each in a separate process."""

from __future__ import annotations

import contextlib
import math
import os
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field, replace
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, ParamSpec, TypeVar

import numpy as np

from runtime.errors import FatalError, InputError, PhasestackError
from runtime.evaluation.solved import PairQuality, SolvedPair
from runtime.evaluation.trials import timed
from runtime.optics.carried import intensities
from runtime.optics.light import ONE_RAY, squared_errors
from runtime.optics.quality import psnr_db
from runtime.records import U8
from runtime.report.pairs import StillPair
from runtime.support.artifacts import write_text
from runtime.support.picture_file import read_image
from runtime.support.sections import read_table
from runtime.support.threads import ahead

if TYPE_CHECKING:
    from runtime.model.predictor import Predictor
    from runtime.optics.stack import PanelStack

P = ParamSpec("P")
T = TypeVar("T")
Kind = Literal["network", "iterative", "layers"]
SHIPPED = ("balanced", "fast", "best")  # the default model comes first in a report
SART = (1, 3, 10, 30)  # iteration counts of the reference methods
ENOUGH_S = 2.0  # total time after which no further runs of a method on a pair are timed
MOST_RUNS = 25  # maximum number of timed runs of one method on one pair
FEWEST_RUNS = 3  # minimum number of timed runs of one method on one pair, unless the method is slow
SLOW_S = 4.0  # a method whose first run takes at least this long runs only once
OFF_STEP = 3  # for displaced eyes, every third ray of every third row is traced
QUOTED = "1"  # the `light_db` key of the figure to quote, at a tracking error of 1 mm


@dataclass(frozen=True, slots=True)
class Method:
    """A method of computing layers: a network, SART, or another solver's stored layers."""

    name: str
    kind: Kind
    source: str  # model name, or path of an ONNX file, as for `load_predictor`; for layers, their folder
    iterations: int = 0  # number of SART iterations; 0 for a network

    def opened(self, stack: PanelStack, *, threads: int) -> Predictor:
        """Load the method's predictor for a stack. Raises InputError if it does not fit, or MissingPart."""
        from runtime.config import ModelSettings
        from runtime.model.predictor import load_predictor
        from runtime.model.sart import SartPredictor

        if self.iterations:
            return SartPredictor(stack, iterations=self.iterations)
        return load_predictor(self.source, stack, ModelSettings(threads=threads))


TIMES = "times.json"  # file with another solver's times in ms, by case


def given_layers(folder: Path, cases: Sequence[StillPair]) -> Method:
    """Return a method for a folder with another solver's layers: `CASE/layer-K.png` and `times.json`.
    Raises InputError if a file is missing or unusable, or without cases.
    """
    if not cases:
        raise InputError(folder, "", "--layers requires --pairs with the case files that the layers were solved for")
    method = Method(folder.name, "layers", str(folder))
    for pair in cases:
        stored_run(method, pair)
    return method


def stored_run(method: Method, pair: StillPair) -> MethodRun:
    """Read another solver's layers and time for a pair. Raises InputError if they are unusable."""
    folder = Path(method.source)
    times = read_table(folder / TIMES)
    time_ms = times.get(pair.name)
    if isinstance(time_ms, bool) or not isinstance(time_ms, int | float) or not 0 < time_ms < math.inf:
        raise InputError(folder / TIMES, pair.name, "must be the time in ms for this case, a number above 0")
    layers = [read_image(folder / pair.name / f"layer-{n}.png") for n in range(pair.stack.count)]
    size = (pair.stack.height_px, pair.stack.width_px)
    for n, layer in enumerate(layers):
        if layer.shape[:2] != size:
            shape = f"{layer.shape[1]}x{layer.shape[0]} pixels, but the case's panels have {size[1]}x{size[0]}"
            raise InputError(folder / pair.name / f"layer-{n}.png", "", f"has {shape}")
        if pair.stack.is_grey(n) and np.ptp(layer[..., :3], axis=2).max() > 0:
            problem = "is coloured, but the case's panel has no colour filters"
            raise InputError(folder / pair.name / f"layer-{n}.png", "", problem)
    return MethodRun(np.stack([layer[..., :3] for layer in layers]), (float(time_ms),), math.nan, 0, "")


def shipped_and_references(models: Sequence[str] = (), *, quick: bool = False) -> list[Method]:
    """Return a report's methods: shipped models, added models, and SART with more and more iterations."""
    methods = [Method(name, "network", name) for name in SHIPPED]
    methods += [Method(Path(name).stem, "network", name) for name in models]
    return methods + [Method(f"SART-{n}", "iterative", "sart", n) for n in (SART[:-1] if quick else SART)]


@dataclass(frozen=True, slots=True)
class MethodRun:
    """Layers computed by one method for one pair in a separate process, with run times and peak memory."""

    layers: U8  # (N, h, w, 3), rear to front
    run_ms: tuple[float, ...]  # times taken by complete solutions, from two decoded images to N 8-bit layers
    memory_mib: float  # the process's peak memory; NaN for layers from elsewhere
    parameters: int
    precision: str


@dataclass(frozen=True, slots=True)
class PairResult:
    """One method's quality, run times and memory on one pair."""

    pair: str  # pair name
    run_ms: tuple[float, ...]
    memory_mib: float
    quality: PairQuality
    psnr_db_off_eye: dict[str, float]  # mean PSNR at displaced eyes, keyed by displacement, such as "2mm"
    viewer: str = ""  # file name of the viewer page that shows the layers; empty if no page was written


@dataclass(frozen=True, slots=True)
class MethodResult:
    """A method's means over all pairs of one resolution: an entry in `methods` in report.json."""

    name: str
    kind: Kind
    precision: str
    width_px: int
    height_px: int
    x_m: tuple[float, ...]  # the panels' positions, rear to front
    ms_p50: float
    ms_p99: float
    memory_mib: float
    parameters: int
    light_db: dict[str, float]  # keyed by tracking error in mm: "0", "1", "2"
    expected_db: dict[str, float]  # keyed by tracking error in mm, with one ray per pixel
    psnr_db: float
    ssim: float
    worst_eye_psnr_db: float  # the worst over all eyes and pairs
    psnr_db_off_eye: dict[str, float]  # keyed by the eye's displacement, such as "2mm"
    pairs: list[PairResult] = field(default_factory=list)

    @property
    def spread_ms(self) -> tuple[float, float]:
        """10th and 90th percentiles of the times in ms, relative to each pair's median, times `ms_p50`."""
        ratios = np.concatenate([np.asarray(pair.run_ms) / np.median(pair.run_ms) for pair in self.pairs])
        low, high = np.percentile(ratios, (10, 90))
        return float(low) * self.ms_p50, float(high) * self.ms_p50

    @property
    def quoted_db(self) -> float:
        """Light PSNR at a tracking error of 1 mm, or NaN if displaced eyes see no part of the panels."""
        return self.light_db.get(QUOTED, math.nan)


def measure(
    methods: Sequence[Method],
    pairs: Iterable[StillPair],
    *,
    threads: int = 2,
    viewers: Path | None = None,
    processes: int = 1,
) -> Iterator[tuple[str, MethodResult | FatalError]]:
    """Yield the method, the pair and the result so far of each method on pairs of one resolution, pair by
    pair; or the error if a measurement failed or its process died. Viewer pages, if there is a folder for them, are
    written only for the first method. `processes` measure at the same time.
    """
    results: dict[str, list[PairResult]] = {method.name: [] for method in methods}

    def measured(method: Method, pair: StillPair) -> tuple[MethodRun, PairResult]:
        is_stored = method.kind == "layers"
        run = stored_run(method, pair) if is_stored else apart(run_method, method, replace(pair, off=()), threads)
        viewer = viewers if method is methods[0] else None
        return run, pair_result(pair, run, viewer=viewer)

    with ThreadPoolExecutor(processes) as pool:
        begun = ((method, pair, pool.submit(measured, method, pair)) for pair in pairs for method in methods)
        for method, pair, future in ahead(begun, processes):
            what = f"{method.name}, {pair.name}"
            try:
                run, found = future.result()
            except FatalError as error:
                yield what, error
                continue
            results[method.name].append(found)
            yield what, _together(method, pair, run, results[method.name])


def apart(function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """Call an importable function in a new process. Raises FatalError for its death or our errors."""
    # Redirect the new process's stdout to stderr, because this process's stdout may be JSON.
    with ProcessPoolExecutor(1, get_context("spawn"), initializer=os.dup2, initargs=(2, 1)) as pool:
        try:
            return pool.submit(_called, function, args, kwargs).result()
        except BrokenProcessPool:
            raise FatalError(f"{function.__name__}: the measuring process died unexpectedly") from None


def _called(function: Callable[..., T], args: Any, kwargs: Any) -> T:
    try:
        return function(*args, **kwargs)
    except (PhasestackError, MemoryError) as error:  # some error classes cannot be pickled
        raise FatalError(str(error) or "not enough memory") from None


def run_method(method: Method, pair: StillPair, threads: int) -> MethodRun:
    """Load, warm up and time a method on a pair, and measure the peak memory of this new process."""
    import cv2

    from runtime.model.still import solve_still

    cv2.setNumThreads(threads)
    predictor = method.opened(pair.stack, threads=threads)
    # Reset the peak. Older kernels refuse; the peak then also covers the interpreter's start-up, which needs less
    # memory.
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    done = timed(
        lambda: solve_still(*pair.images, eyes_m=pair.eyes_m, fov_deg=pair.fov_deg, predictor=predictor).layers,
        runs=FEWEST_RUNS,
        most=MOST_RUNS,
        enough_s=ENOUGH_S,
        slow_s=SLOW_S,
    )
    layers, peak_mib = np.array(done.answer[..., :3]), _peak_mib()
    return MethodRun(layers, done.times_ms, peak_mib, predictor.facts.parameters, predictor.facts.precision)


def _peak_mib() -> float:
    status = Path("/proc/self/status").read_text(encoding="ascii")
    return int(status.partition("VmHWM:")[2].split()[0]) / 1024


def pair_result(pair: StillPair, run: MethodRun, *, viewer: Path | None = None) -> PairResult:
    """Measure layers at the pair's eyes and displaced eyes (docs/contracts.md, Error)."""
    at_eyes = SolvedPair(run.layers, pair.images, pair.stack, pair.eyes_m, pair.fov_deg)
    off: dict[str, list[float]] = {}
    sampling = ONE_RAY._replace(step=OFF_STEP)
    for view in pair.off:
        place = view.eye_m[None]
        where: Any = {"solved_for_m": place, "eyes_m": place, "fov_deg": pair.fov_deg, "sampling": sampling}
        with contextlib.suppress(ValueError):  # raised if the displaced eye sees no part of the panels
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
        x_m=pair.stack.x_m,
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
    """Return the mean of the finite values for each key. Keys without any finite value are omitted."""
    keys = dict.fromkeys(key for table in tables for key in table)
    values_of = {key: [table[key] for table in tables if math.isfinite(table.get(key, math.nan))] for key in keys}
    return {key: float(np.mean(values)) for key, values in values_of.items() if values}
