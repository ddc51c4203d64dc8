"""How far ahead the tracker can see: prediction error over the horizon, and what it is worth in displayed PSNR."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from runtime.clock import NS_PER_MS, NS_PER_S
from runtime.eyes.motions import MOTIONS, observe, true_eyes
from runtime.eyes.tracker import Tracker
from runtime.records import F64
from runtime.report.page import Figure, Section, Table
from runtime.report.plots import COLOURS, drawing, png
from runtime.report.sweeps import Tolerance

HORIZONS_MS = (0, 20, 40, 60, 80, 100, 120)
SECONDS, RATE_HZ = 20.0, 30.0


@dataclass(frozen=True, slots=True)
class Horizon:
    """One motion: error of the eyes' places, mm, over the horizon."""

    motion: str
    tracked_mm: F64  # (horizons, 2): p50, p95
    untracked_mm: F64  # the newest sample taken as it is


def measure(motion: str) -> Horizon:
    """The shipped tracker on 30 Hz samples with 3 mm of noise, 5% outliers and dropouts of 200 ms."""
    tracker = Tracker()
    tracked: list[list[float]] = [[] for _ in HORIZONS_MS]
    untracked: list[list[float]] = [[] for _ in HORIZONS_MS]
    newest: F64 | None = None
    for sample in observe(motion, seconds=SECONDS, rate_hz=RATE_HZ):
        tracker.update(sample.points, capture_ns=sample.capture_ns)
        newest = newest if sample.points is None else sample.points.eyes_m
        if sample.capture_ns < NS_PER_S or newest is None:
            continue
        for index, horizon_ms in enumerate(HORIZONS_MS):
            when_ns = sample.capture_ns + horizon_ms * NS_PER_MS
            truth = true_eyes(motion, np.array([when_ns / NS_PER_S, SECONDS + 1.0]))[0]
            found = tracker.at(when_ns).eyes_m
            if found is not None:
                tracked[index].append(_apart_mm(found, truth))
            untracked[index].append(_apart_mm(newest, truth))
    return Horizon(motion, *(np.percentile(np.array(errors), [50, 95], axis=1).T for errors in (tracked, untracked)))


def _apart_mm(found: F64, truth: F64) -> float:
    return float(np.linalg.norm(found - truth, axis=1).mean() * 1000)


def all_motions() -> list[Horizon]:
    """Every motion that the tracker is measured with."""
    return [measure(motion) for motion in MOTIONS]


def psnr_at(tolerance: Tolerance, error_mm: float) -> float:
    """What an error of that size leaves of the picture: the tolerance map's mean over directions, interpolated."""
    offsets = np.array(tolerance.offsets_mm, dtype=float)
    distance = np.hypot(*np.meshgrid(offsets, offsets[::-1]))
    rings = np.unique(np.abs(offsets))
    means = [tolerance.psnr_db[np.abs(distance - ring) <= 0.75].mean() for ring in rings]
    return float(np.interp(error_mm, rings, means))


def _price(tolerance: Tolerance, error_mm: float) -> str:
    beyond = error_mm > max(tolerance.offsets_mm)
    return ("below " if beyond else "") + f"{psnr_at(tolerance, error_mm):.1f}"


def horizon_section(horizons: Sequence[Horizon], tolerance: Tolerance) -> Section:
    """Error over the horizon, and its price."""
    with drawing(9.6, 3.6) as figure:
        all_axes = figure.subplots(1, len(horizons), sharey=True)
        for axes, horizon, colour in zip(all_axes, horizons, COLOURS, strict=False):
            axes.plot(HORIZONS_MS, horizon.tracked_mm[:, 0], color=colour)
            axes.fill_between(HORIZONS_MS, horizon.tracked_mm[:, 0], horizon.tracked_mm[:, 1], color=colour, alpha=0.2)
            axes.plot(HORIZONS_MS, horizon.untracked_mm[:, 1], color="#9aa3b5", linestyle="--", linewidth=1.2)
            axes.set_title(horizon.motion, fontsize=10)
            axes.set_xlabel("ahead, ms")
        all_axes[0].set(ylabel="error of the eyes' places, mm", ylim=(0, 60))
    rows = []
    index = HORIZONS_MS.index(60)
    for horizon in horizons:
        half, most = horizon.tracked_mm[index]
        plain = horizon.untracked_mm[index]
        prices = [_price(tolerance, float(error)) for error in (half, plain[0])]
        rows.append([horizon.motion, f"{half:.1f}", f"{most:.1f}", f"{plain[0]:.1f}", f"{plain[1]:.1f}"])
        rows[-1] += prices
    headings = ["motion", "p50 mm", "p95 mm", "untracked p50", "untracked p95", "PSNR at p50, dB", "untracked, dB"]
    text = [
        "Between the camera's exposure and the light that leaves the panels lie 60 to 90 ms. The line is the median "
        "error of the tracker, the band reaches to its 95th percentile; dashed: the 95th percentile of the newest "
        "sample taken as it is, cut off above 60 mm.",
    ]
    caption = "Heads at 0.6 m, 30 samples a second, 3 mm of noise, 5% outliers, dropouts of 200 ms."
    table = Table(
        headings, rows, "60 ms ahead. The PSNR (carried) is what an error of that size leaves of the picture."
    )
    return Section("Tracker horizon", text, [Figure("tracker-horizon", png(figure), caption)], [table])
