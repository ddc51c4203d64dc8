"""The frontier's regression file: a quick frontier and the stages' times, beside a yardstick of the machine's speed."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import monotonic, perf_counter_ns
from typing import Any

import cv2
import numpy as np

from runtime.clock import NS_PER_MS
from runtime.config import ModelSettings, StackGeometry, read_table
from runtime.errors import InputError
from runtime.evaluation.trials import timed
from runtime.model.backends import Wanted
from runtime.optics.stack import PanelStack
from runtime.plan.drawing import drawn_for
from runtime.records import F64
from runtime.report.frontier import measure
from runtime.report.machine import describe
from runtime.report.methods import Method
from runtime.report.pairs import FOV_DEG, Painter, eyes_at

VERSION = 1
MODELS = ("fast", "balanced", "best")
SIZES = ((960, 540), (1920, 1080))
RUNS = 15
WORSE_DB = 0.1  # more than rounding and the order of threads can change
SLOWER = 0.15  # at least; more where the runs themselves scatter more
MORE_MEMORY = 0.15
UNSTEADY = 1.3  # times the least yardstick: the machine's speed changed by more than a difference that counts
OTHERS_CORES = 0.5
SCATTERS = 3.0  # of the medians' own scatter before a difference counts


def yardstick_ms() -> float:
    """A fixed piece of work of the same kinds (warp, table, product of matrices): median of nine."""
    picture = np.random.default_rng(0).integers(0, 256, (1080, 1920, 4), dtype=np.uint8)
    left = np.random.default_rng(1).random((1080, 240), dtype=np.float32)
    right = np.random.default_rng(2).random((240, 1920), dtype=np.float32)
    matrix = np.array([[1.01, 0.0, 3.3], [0.0, 1.01, 1.7]])
    table = np.arange(256, dtype=np.uint8)[::-1].copy()

    def work() -> None:
        cv2.LUT(cv2.warpAffine(picture, matrix, (1920, 1080)), table)
        _ = left @ right

    return timed(work, runs=9).median_ms


def scatter(values: Sequence[float]) -> float:
    """How far a median of these may be off, relative: 1.4826·MAD·1.25/sqrt(n)."""
    middle = float(np.median(values))
    deviation = float(np.median(np.abs(np.asarray(values) - middle)))
    relative: float = 1.4826 * 1.2533 * deviation / middle / len(values) ** 0.5
    return relative


def stage_times(model: str, stack: PanelStack, eyes_m: F64, *, backend: Wanted = "opencv") -> dict[str, Any]:
    """Medians of what a frame costs, stage by stage, drawn and predicted as the daemon does."""
    from runtime.model.backends import choose
    from runtime.model.predictor import load_predictor

    predictor = load_predictor(model, stack, ModelSettings())
    stages: dict[str, list[float]] = {}
    with Painter("demo", stack) as painter:
        # Drawn and solved in one context, as the daemon does.
        predictor.surround_with(choose(backend, predictor, lambda: painter.context).backend)

        def frame() -> None:
            start_ns = perf_counter_ns()
            images = drawn_for(predictor, painter.content, eyes_m, time_ns=0)
            render_ms = (perf_counter_ns() - start_ns) / NS_PER_MS
            prediction = predictor.predict(images, eyes_m)
            for name, value in ({"render": render_ms} | prediction.stage_ms).items():
                stages.setdefault(name, []).append(value)

        done = timed(frame, runs=RUNS, warm_up=2)
        predictor.close()
    return {
        "name": model,
        "backend": predictor.backend,
        "width_px": stack.width_px,
        "height_px": stack.height_px,
        "stage_ms": {name: float(np.median(values[-RUNS:])) for name, values in stages.items()},
        "total_ms": done.median_ms,
        "total_scatter": scatter(done.times_ms),
    }


def measured(
    *,
    sizes: Sequence[tuple[int, int]] = SIZES,
    backend: Wanted = "opencv",
    progress: Callable[[str], None] = lambda text: None,
) -> dict[str, Any]:
    """The regression file's content. Takes about a minute."""
    yardsticks, stages, methods = [yardstick_ms()], [], []
    others = OthersLoad()
    eyes = eyes_at(distance_m=0.6, height_m=0.05)
    for width, height in sizes:
        stack = replace(StackGeometry().stack(), width_px=width, height_px=height)
        with Painter("demo", stack) as painter:
            pair = painter.pair("demo", eyes, stack, fov_deg=FOV_DEG, off_mm=(2,))
        for model in MODELS:
            progress(f"{model} {width}x{height}")
            stages.append(stage_times(model, stack, eyes, backend=backend))
            result = measure([Method(model, "network", model, backend=backend)], [pair])[0]
            methods.append({key: value for key, value in result.record().items() if key != "pairs"})
            yardsticks.append(yardstick_ms())
    return {
        "version": VERSION,
        "machine": describe(seed=0),
        "yardstick_ms": float(np.median(yardsticks)),
        "yardsticks_ms": yardsticks,  # over the whole measurement: whether the machine stayed as fast
        "others_cores": others.cores(),
        "methods": methods,
        "stages": stages,
    }


class OthersLoad:
    """How many cores other programs took since this was made, on average; what our own processes took is left out."""

    def __init__(self) -> None:
        self._begin_s, self._all_s, self._own_s = monotonic(), _busy_s(), _own_s()

    def cores(self) -> float | None:
        """None where the system does not tell."""
        all_s, seconds = _busy_s(), monotonic() - self._begin_s
        if self._all_s is None or all_s is None or seconds <= 0:
            return None
        return round(max(0.0, (all_s - self._all_s - (_own_s() - self._own_s)) / seconds), 3)


def _busy_s() -> float | None:
    """Of all cores together, since the machine was started."""
    try:
        user, nice, system, _, _, irq, soft = Path("/proc/stat").read_text(encoding="ascii").split("\n")[0].split()[1:8]
        return sum(map(int, (user, nice, system, irq, soft))) / os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError):
        return None


def _own_s() -> float:
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def too_busy(table: dict[str, Any]) -> str:
    """Why a file's times can't be compared: the machine had other things to do. Empty: they can."""
    yardsticks = table.get("yardsticks_ms") or []
    if len(yardsticks) > 1 and max(yardsticks) > UNSTEADY * min(yardsticks):
        return f"the same work took {min(yardsticks):.1f} to {max(yardsticks):.1f} ms while it was measured"
    others = table.get("others_cores")
    if isinstance(others, int | float) and others > OTHERS_CORES:
        return f"other programs took {others:.1f} cores while it was measured"
    return ""


@dataclass(frozen=True, slots=True)
class Change:
    """One thing that differs between two files beyond noise."""

    what: str
    worse: bool
    text: str


def compare(old: dict[str, Any], new: dict[str, Any]) -> list[Change]:
    """What got slower, faster, worse or better. Times are compared as multiples of each file's own yardstick.

    Where the machine was too busy in either (`too_busy`) they are not compared at all.
    """
    changes: list[Change] = []
    machine = new["yardstick_ms"] / old["yardstick_ms"]
    comparable = not (too_busy(old) or too_busy(new))
    for before, after in _matched(old["stages"], new["stages"], changes):
        if not comparable:
            continue
        ratio = after["total_ms"] / before["total_ms"] / machine
        noise = max(SLOWER, SCATTERS * float(np.hypot(before["total_scatter"], after["total_scatter"])))
        if ratio > 1 + noise or ratio < 1 / (1 + noise):
            text = f"{ratio:.2f} times the time of a frame (noise {noise:.0%})"
            changes.append(Change(_name(after), ratio > 1, text))
    for before, after in _matched(old["methods"], new["methods"], changes):
        for key, label in (("psnr_db", "at the eyes"), ("worst_eye_psnr_db", "at the worse eye")):
            gain = after[key] - before[key]
            if abs(gain) > WORSE_DB:
                changes.append(Change(_name(after), gain < 0, f"{gain:+.2f} dB {label}"))
        for sigma in sorted(before.get("expected_db", {}).keys() & after.get("expected_db", {}).keys()):
            gain = after["expected_db"][sigma] - before["expected_db"][sigma]
            if abs(gain) > WORSE_DB:
                changes.append(Change(_name(after), gain < 0, f"{gain:+.2f} dB expected of eyes unsure by {sigma} mm"))
        gain = after["psnr_db_off_eye"].get("2mm", 0.0) - before["psnr_db_off_eye"].get("2mm", 0.0)
        if abs(gain) > WORSE_DB:
            changes.append(Change(_name(after), gain < 0, f"{gain:+.2f} dB 2 mm off the eyes"))
        ratio = after["memory_mib"] / before["memory_mib"]
        if ratio > 1 + MORE_MEMORY or ratio < 1 / (1 + MORE_MEMORY):
            changes.append(Change(_name(after), ratio > 1, f"{ratio:.2f} times the memory"))
    return changes


def _matched(
    old: Sequence[dict[str, Any]], new: Sequence[dict[str, Any]], changes: list[Change]
) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    after = {_name(entry): entry for entry in new}
    pairs = []
    for entry in old:
        if _name(entry) in after:
            pairs.append((entry, after[_name(entry)]))
        elif not any(change.what == _name(entry) for change in changes):
            changes.append(Change(_name(entry), True, "is missing from the new file"))
    return pairs


def _name(entry: dict[str, Any]) -> str:
    return f"{entry['name']} {entry['width_px']}x{entry['height_px']}"


NUMBERS = {
    "stages": ("total_ms", "total_scatter", "width_px", "height_px"),
    "methods": ("psnr_db", "worst_eye_psnr_db", "memory_mib", "width_px", "height_px"),
}


def read(path: Path) -> dict[str, Any]:
    """A regression file. Raises InputError, naming file and field, for anything else."""
    table = read_table(path)
    if table.get("version") != VERSION:
        raise InputError(path, "version", f"must be {VERSION}: made by `phasestack bench`")
    if not _is_positive(table.get("yardstick_ms")):
        raise InputError(path, "yardstick_ms", "must be a positive number")
    yardsticks = table.get("yardsticks_ms", [])  # files of earlier versions have none
    if not isinstance(yardsticks, list) or not all(_is_positive(value) for value in yardsticks):
        raise InputError(path, "yardsticks_ms", "must be a list of positive numbers")
    for name, keys in NUMBERS.items():
        entries = table.get(name)
        if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
            raise InputError(path, name, "must be a list of tables")
        for index, entry in enumerate(entries):
            for key in keys:
                if not isinstance(entry.get(key), int | float):
                    raise InputError(path, f"{name}[{index}].{key}", "must be a number")
            if not isinstance(entry.get("name"), str):
                raise InputError(path, f"{name}[{index}].name", "must be a name")
            if name == "methods" and not isinstance(entry.get("psnr_db_off_eye"), dict):
                raise InputError(path, f"{name}[{index}].psnr_db_off_eye", "must be a table")
            expected = entry.get("expected_db", {})  # files of earlier versions have none
            if not isinstance(expected, dict) or not all(isinstance(db, int | float) for db in expected.values()):
                raise InputError(path, f"{name}[{index}].expected_db", "must be a table of numbers")
    return table


def _is_positive(value: Any) -> bool:
    return isinstance(value, int | float) and value > 0
