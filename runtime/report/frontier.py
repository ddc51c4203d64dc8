"""Error against run time: every method on every pair, in one run, each method in a process of its own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from runtime.errors import InputError
from runtime.evaluation.trials import timed
from runtime.records import U8
from runtime.report.eyesight import Seen, judged
from runtime.report.kept import measured_anew
from runtime.report.methods import Kind, Method, opened
from runtime.report.pairs import StillPair
from runtime.report.worker import apart

ENOUGH_S = 2.0  # of timed runs on one pair; slow methods run once
MOST_RUNS = 25
FEWEST_RUNS = 3
SLOW_S = 4.0  # a first run that takes longer counts, and is the only one


@dataclass(frozen=True, slots=True)
class MethodRun:
    """One method on one pair, as the process that ran it saw it."""

    layers: U8
    run_ms: list[float]  # whole predictions: two decoded images to N 8-bit layers
    memory_mib: float  # the process's peak
    parameters: int
    precision: str
    multiply_adds: int


@dataclass(frozen=True, slots=True)
class PairResult:
    """One method on one pair."""

    pair: str
    psnr_db: float  # exact
    ssim: float
    eye_psnr_db: tuple[float, ...]
    psnr_db_off_eye: dict[str, float]
    ms_p50: float
    expected_db: dict[str, float]  # by the eyes' uncertainty in millimetres: "1", "2"


@dataclass(frozen=True, slots=True)
class MethodResult:
    """One method over all pairs of one resolution: an entry of `methods` in report.json."""

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
    psnr_db: float  # exact; mean over pairs
    ssim: float
    worst_eye_psnr_db: float  # least of all eyes and pairs
    psnr_db_off_eye: dict[str, float]
    multiply_adds: float  # of one prediction, mean over pairs
    expected_db: dict[str, float] = field(default_factory=dict)  # by the eyes' uncertainty in mm; mean over pairs
    scale: float = 1.0  # of the panels' columns and rows that a network works at
    trained: bool = True  # where not, the picture is nobody's: time, memory and sizes count, the error does not
    pairs: list[PairResult] = field(default_factory=list)

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
    return MethodRun(
        layers, list(done.times_ms), peak_mib, ready.parameters, ready.precision, ready.multiply_adds(pair)
    )


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
    methods: Sequence[Method],
    pairs: Sequence[StillPair],
    *,
    threads: int = 2,
    progress: Callable[[int, int], None] = lambda done, of: None,
    keep: Callable[[str, Callable[[], Any]], Any] = measured_anew,
) -> list[MethodResult]:
    """Every method on every pair; one without training on the first alone. Pairs of one call share a resolution.

    keep: takes each method's name and how to measure it. Raises FatalError where a method fails.
    """
    results: list[MethodResult] = []
    for index, method in enumerate(methods):
        results.append(keep(method.name, partial(_measured, method, pairs, threads)))
        progress(index + 1, len(methods))
    return results


def _measured(method: Method, pairs: Sequence[StillPair], threads: int) -> MethodResult:
    runs = []
    for pair in pairs if method.trained else pairs[:1]:
        run = apart(run_method, method, replace(pair, off=()), threads)
        runs.append((pair, run, judged(pair, run.layers)))
    return _together(method, runs)


def _together(method: Method, runs: Sequence[tuple[StillPair, MethodRun, Seen]]) -> MethodResult:
    all_ms = np.concatenate([run.run_ms for _, run, _ in runs])
    pairs = [
        PairResult(
            pair.name,
            seen.quality.psnr_db,
            seen.quality.ssim,
            seen.quality.eye_psnr_db,
            seen.off_db,
            float(np.median(run.run_ms)),
            seen.expected_db,
        )
        for pair, run, seen in runs
    ]
    distances = list(dict.fromkeys(name for result in pairs for name in result.psnr_db_off_eye))
    first = runs[0][0].stack
    return MethodResult(
        name=method.name,
        kind=method.kind,
        precision=runs[0][1].precision,
        width_px=first.width_px,
        height_px=first.height_px,
        ms_p50=float(np.median(all_ms)),
        ms_p99=float(np.percentile(all_ms, 99)),
        runs=len(all_ms),
        memory_mib=max(run.memory_mib for _, run, _ in runs),
        parameters=runs[0][1].parameters,
        psnr_db=float(np.mean([result.psnr_db for result in pairs])),
        ssim=float(np.mean([result.ssim for result in pairs])),
        worst_eye_psnr_db=min(min(result.eye_psnr_db) for result in pairs),
        psnr_db_off_eye={
            name: float(np.mean([r.psnr_db_off_eye[name] for r in pairs if name in r.psnr_db_off_eye]))
            for name in distances
        },
        expected_db={
            name: float(np.mean([r.expected_db[name] for r in pairs if name in r.expected_db]))
            for name in dict.fromkeys(name for result in pairs for name in result.expected_db)
        },
        multiply_adds=float(np.mean([run.multiply_adds for _, run, _ in runs])),
        scale=method.scale,
        trained=method.trained,
        pairs=pairs,
    )


def pareto(results: Sequence[MethodResult]) -> list[MethodResult]:
    """Those that nothing else beats in both time and quality, fastest first; the untrained have no quality."""
    front: list[MethodResult] = []
    for result in sorted((r for r in results if r.trained), key=lambda r: (r.ms_p50, -r.psnr_db)):
        if not front or result.psnr_db > front[-1].psnr_db:
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
