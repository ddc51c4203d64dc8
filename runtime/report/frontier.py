"""Error against run time: every method on every pair, in one run, each method in a process of its own."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from runtime.errors import InputError
from runtime.evaluation.displayed import displayed, expected_db, light_db
from runtime.evaluation.trials import timed
from runtime.optics.carried import intensities
from runtime.optics.light import squared_error
from runtime.optics.quality import psnr_db
from runtime.records import U8
from runtime.report.methods import Kind, Method, opened
from runtime.report.pairs import StillPair
from runtime.report.worker import apart

ENOUGH_S = 2.0  # of timed runs on one pair; slow methods run once
MOST_RUNS = 25
FEWEST_RUNS = 3
SLOW_S = 4.0  # a first run that takes longer counts, and is the only one
ENOUGH_PIXELS = 200_000  # of an eye's picture, for an expected error: within some hundredths of a decibel
OFF_STEP = 3  # away from the eyes, every third ray of every third row is enough
QUOTED = "1"  # of `light_db`: eyes sure to 1 mm, a pupil


@dataclass(frozen=True, slots=True)
class MethodRun:
    """One method on one pair, as the process that ran it saw it."""

    layers: U8
    run_ms: list[float]  # whole predictions: two decoded images to N 8-bit layers
    memory_mib: float  # the process's peak
    parameters: int
    precision: str


@dataclass(frozen=True, slots=True)
class PairResult:
    """One method on one pair."""

    pair: str
    run_ms: list[float]
    memory_mib: float
    light_db: dict[str, float]  # by how sure the eyes are, millimetres: "0", "1", "2"
    expected_db: dict[str, float]  # the same, one ray a pixel
    psnr_db: float
    ssim: float
    eye_psnr_db: tuple[float, ...]
    psnr_db_off_eye: dict[str, float]


@dataclass(frozen=True, slots=True)
class MethodResult:
    """One method over all pairs of one resolution so far: an entry of `methods` in report.json. Means over pairs."""

    name: str
    kind: Kind
    precision: str
    width_px: int
    height_px: int
    ms_p50: float
    ms_p99: float
    runs: int
    memory_mib: float
    parameters: int
    light_db: dict[str, float]
    expected_db: dict[str, float]
    psnr_db: float
    ssim: float
    worst_eye_psnr_db: float  # least of all eyes and pairs
    psnr_db_off_eye: dict[str, float]
    trained: bool = True  # where not, the picture is nobody's: time, memory and sizes count, the error does not
    pairs: list[PairResult] = field(default_factory=list)

    @property
    def quoted_db(self) -> float:
        """The one figure to quote. NaN where such eyes see nothing."""
        return self.light_db.get(QUOTED, math.nan)

    def record(self) -> dict[str, Any]:
        """As report.json has it."""
        return asdict(self)


def run_method(method: Method, pair: StillPair, threads: int) -> MethodRun:
    """Open, warm up, time, and note the peak of memory. Runs in a process of its own."""
    import cv2

    cv2.setNumThreads(threads)
    ready = opened(method, pair, threads=threads)
    _forget_peak()
    done = timed(lambda: ready.solve(pair), runs=FEWEST_RUNS, most=MOST_RUNS, enough_s=ENOUGH_S, slow_s=SLOW_S)
    layers, peak_mib = np.array(done.answer[..., :3]), _peak_mib()
    return MethodRun(layers, list(done.times_ms), peak_mib, ready.parameters, ready.precision)


def _forget_peak() -> None:
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    except OSError:
        return  # an older kernel: the peak then includes the start of the interpreter, which is less


def _peak_mib() -> float:
    for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) / 1024
    return float("nan")


def measure(
    methods: Sequence[Method], pairs: Iterable[StillPair], *, threads: int = 2
) -> Iterator[tuple[str, list[MethodResult]]]:
    """Every method on every pair, pair by pair; one without training on the first alone. Pairs share a resolution.

    Yields what was measured last and the results so far, in the methods' order. Raises FatalError where one fails.
    """
    found: dict[str, MethodResult] = {}
    for number, pair in enumerate(pairs):
        for method in methods if number == 0 else [method for method in methods if method.trained]:
            run = apart(run_method, method, replace(pair, off=()), threads)
            so_far = found[method.name].pairs if method.name in found else []
            found[method.name] = _together(method, pair, run, [*so_far, judged(pair, run)])
            yield f"{method.name}, {pair.name}", list(found.values())


def judged(pair: StillPair, run: MethodRun) -> PairResult:
    """Displayed quality (docs/contracts.md, Error) at the eyes, expected of unsure ones, and at places beside them."""
    layers, stack = run.layers, pair.stack
    where: Any = {"eyes_m": pair.eyes_m, "fov_deg": pair.fov_deg}
    eye_views = displayed(layers, pair.wanted, stack, **where)
    where["step"] = max(1, math.isqrt(pair.images[0].shape[0] * pair.images[0].shape[1] // ENOUGH_PIXELS))
    off: dict[str, list[float]] = {}
    for view in pair.off:
        place, target = view.eye_m[None], [intensities(view.image)]
        with contextlib.suppress(ValueError):  # nothing is seen from there
            error = squared_error(
                layers, target, stack, solved_for_m=place, eyes_m=place, fov_deg=pair.fov_deg, rays=0, step=OFF_STEP
            )
            off.setdefault(f"{view.mm:g}mm", []).append(psnr_db(error))
    light, expected = (
        {sigma: value for sigma, value in measured(eye_views, layers, stack, **where).items() if value is not None}
        for measured in (light_db, expected_db)
    )
    exact = eye_views.quality
    beside = {name: float(np.mean(values)) for name, values in off.items()}
    figures = (light, expected, exact.psnr_db, exact.ssim, exact.eye_psnr_db, beside)
    return PairResult(pair.name, run.run_ms, run.memory_mib, *figures)


def _together(method: Method, pair: StillPair, run: MethodRun, pairs: list[PairResult]) -> MethodResult:
    all_ms = np.concatenate([one.run_ms for one in pairs])

    def means(name: str) -> dict[str, float]:
        tables = [getattr(one, name) for one in pairs]
        keys = dict.fromkeys(key for table in tables for key in table)
        return {key: float(np.mean([table[key] for table in tables if key in table])) for key in keys}

    return MethodResult(
        name=method.name,
        kind=method.kind,
        precision=run.precision,
        width_px=pair.stack.width_px,
        height_px=pair.stack.height_px,
        ms_p50=float(np.median(all_ms)),
        ms_p99=float(np.percentile(all_ms, 99)),
        runs=len(all_ms),
        memory_mib=max(one.memory_mib for one in pairs),
        parameters=run.parameters,
        light_db=means("light_db"),
        expected_db=means("expected_db"),
        psnr_db=float(np.mean([one.psnr_db for one in pairs])),
        ssim=float(np.mean([one.ssim for one in pairs])),
        worst_eye_psnr_db=min(min(one.eye_psnr_db) for one in pairs),
        psnr_db_off_eye=means("psnr_db_off_eye"),
        trained=method.trained,
        pairs=pairs,
    )


def pareto(results: Sequence[MethodResult]) -> list[MethodResult]:
    """Those that nothing else beats in both time and light, fastest first; the untrained have no picture."""
    front: list[MethodResult] = []
    for result in sorted((r for r in results if r.trained), key=lambda r: (r.ms_p50, -r.quoted_db)):
        if not front or result.quoted_db > front[-1].quoted_db:
            front.append(result)
    return front


def check_models(names: Sequence[str]) -> None:
    """Raises InputError for an ONNX file that isn't there or isn't ours, before anything is measured."""
    from runtime.model.session import ModelSession

    for name in names:
        path = Path(name)
        if not path.is_file():
            raise InputError(path, "", "is not a file")
        ModelSession(path, provider="cpu", threads=1)
