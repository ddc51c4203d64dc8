"""The frontier's regression file: time, light and memory of the shipped models, beside a yardstick of the machine."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import monotonic
from typing import Any

import cv2
import numpy as np

from runtime.config import StackGeometry, read_table
from runtime.errors import InputError
from runtime.evaluation.trials import timed
from runtime.report.frontier import measure
from runtime.report.machine import describe
from runtime.report.methods import SHIPPED, Method
from runtime.report.pairs import FOV_DEG, Painter, eyes_at

VERSION = 2
SIZES = ((960, 540), (1920, 1080))
WORSE_DB = 0.1  # more than rounding and the order of threads can change
SLOWER = 0.15  # at least; more where the runs themselves scatter more
MORE_MEMORY = 0.15
UNSTEADY = 1.3  # times the least yardstick: the machine's speed changed by more than a difference that counts
OTHERS_CORES = 0.5
SCATTERS = 3.0  # of the medians' own scatter before a difference counts
NUMBERS = ("ms_p50", "scatter", "psnr_db", "worst_eye_psnr_db", "memory_mib", "width_px", "height_px")


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


def measured(
    *, sizes: Sequence[tuple[int, int]] = SIZES, progress: Callable[[str], None] = lambda text: None
) -> dict[str, Any]:
    """The regression file's content. Takes about a minute."""
    yardsticks, methods = [yardstick_ms()], []
    others = OthersLoad()
    shipped = [Method(name, "network", name) for name in SHIPPED]
    for width, height in sizes:
        stack = replace(StackGeometry().stack(), width_px=width, height_px=height)
        with Painter("demo", stack) as painter:
            pair = painter.pair("demo", eyes_at(distance_m=0.6, height_m=0.05), stack, fov_deg=FOV_DEG, off_mm=())
        for done, so_far in measure(shipped, [pair]):
            progress(f"{width}x{height}: {done} is done")
            yardsticks.append(yardstick_ms())
            results = so_far
        for result in results:
            record = result.record()
            runs = [ms for one in record.pop("pairs") for ms in one["run_ms"]]
            methods.append(record | {"scatter": scatter(runs)})
    return {
        "version": VERSION,
        "machine": describe(seed=0),
        "yardstick_ms": float(np.median(yardsticks)),
        "yardsticks_ms": yardsticks,  # over the whole measurement: whether the machine stayed as fast
        "others_cores": others.cores(),
        "methods": methods,
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
    yardsticks = table["yardsticks_ms"]
    if max(yardsticks) > UNSTEADY * min(yardsticks):
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
    later = {_name(entry): entry for entry in new["methods"]}
    machine = new["yardstick_ms"] / old["yardstick_ms"]
    comparable = not (too_busy(old) or too_busy(new))
    changes: list[Change] = []
    for before in old["methods"]:
        name = _name(before)
        if name not in later:
            changes.append(Change(name, True, "is missing from the new file"))
            continue
        after = later[name]
        if comparable:
            noise = max(SLOWER, SCATTERS * float(np.hypot(before["scatter"], after["scatter"])))
            ratio = after["ms_p50"] / before["ms_p50"] / machine
            changes += _times(name, ratio, noise, f"the time of a solution (noise {noise:.0%})")
        changes += _times(name, after["memory_mib"] / before["memory_mib"], MORE_MEMORY, "the memory")
        for label, gain in _gains(before, after):
            if abs(gain) > WORSE_DB:
                changes.append(Change(name, gain < 0, f"{gain:+.2f} dB {label}"))
    return changes


def _times(name: str, ratio: float, noise: float, of_what: str) -> list[Change]:
    beyond = ratio > 1 + noise or ratio < 1 / (1 + noise)
    return [Change(name, ratio > 1, f"{ratio:.2f} times {of_what}")] if beyond else []


def _gains(before: dict[str, Any], after: dict[str, Any]) -> Iterator[tuple[str, float]]:
    for sigma in sorted(before["light_db"].keys() & after["light_db"].keys()):
        yield f"of light, eyes sure to {sigma} mm", after["light_db"][sigma] - before["light_db"][sigma]
    yield "one ray a pixel", after["psnr_db"] - before["psnr_db"]
    yield "one ray a pixel, at the worse eye", after["worst_eye_psnr_db"] - before["worst_eye_psnr_db"]


def _name(entry: dict[str, Any]) -> str:
    return f"{entry['name']} {entry['width_px']}x{entry['height_px']}"


def read(path: Path) -> dict[str, Any]:
    """A regression file. Raises InputError, naming file and field, for anything else."""
    table = read_table(path)
    if table.get("version") != VERSION:
        raise InputError(path, "version", f"must be {VERSION}: made by `phasestack bench` of this version")
    if not _is_positive(table.get("yardstick_ms")):
        raise InputError(path, "yardstick_ms", "must be a positive number")
    yardsticks = table.get("yardsticks_ms")
    if not isinstance(yardsticks, list) or not yardsticks or not all(_is_positive(value) for value in yardsticks):
        raise InputError(path, "yardsticks_ms", "must be a list of positive numbers")
    entries = table.get("methods")
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise InputError(path, "methods", "must be a list of tables")
    for index, entry in enumerate(entries):
        for key in NUMBERS:
            if not isinstance(entry.get(key), int | float):
                raise InputError(path, f"methods[{index}].{key}", "must be a number")
        if not isinstance(entry.get("name"), str):
            raise InputError(path, f"methods[{index}].name", "must be a name")
        light = entry.get("light_db")
        if not isinstance(light, dict) or not all(isinstance(db, int | float) for db in light.values()):
            raise InputError(path, f"methods[{index}].light_db", "must be a table of numbers")
    return table


def _is_positive(value: Any) -> bool:
    return isinstance(value, int | float) and value > 0
