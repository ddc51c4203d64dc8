"""Quality over one thing at a time: place of the viewer, error of the tracker, gap, resolution, tolerance knob."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from runtime.evaluation.trials import timed
from runtime.optics.carried import carried_quality
from runtime.optics.stack import PanelStack
from runtime.optics.views import stack_from_eye
from runtime.records import F64
from runtime.report.pairs import eyes_at
from runtime.report.simulate import Simulation

ANGLES_DEG = tuple(range(-70, 71, 10))
DISTANCES_M = (0.1, 0.15, 0.25, 0.4, 0.6, 0.9, 1.4, 2.0, 3.0, 4.0)
GAPS_M = (0.005, 0.01, 0.02, 0.03, 0.06, 0.1, 0.2, 0.5)
SOLVED_FOR_MM = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0)
SEEN_WITH_MM = (0.0, 1.0, 2.0, 4.0)
MAP_STEP = 2  # of the off-eye map's rays: with 10^5 and more of them, every second is enough
NEAREST_M = 0.03  # before the front panel; nearer eyes are left blank


@dataclass(frozen=True, slots=True)
class Volume:
    """Displayed PSNR over where the viewer is: exact, and what a pupil (1 mm) sees."""

    angles_deg: Sequence[float]
    distances_m: Sequence[float]
    psnr_db: F64  # (distances, angles), NaN where there is no picture
    expected_db: F64  # the same, of eyes unsure by 1 mm


def viewing_volume(simulation: Simulation) -> Volume:
    """Both eyes' pooled PSNR with the eyes' own layers, at every place."""
    exact, expected = np.full((2, len(DISTANCES_M), len(ANGLES_DEG)), np.nan)
    front_m = max(simulation.stack.x_m)
    for row, distance_m in enumerate(DISTANCES_M):
        for column, angle_deg in enumerate(ANGLES_DEG):
            eyes = eyes_at(distance_m=distance_m, angle_deg=angle_deg)
            if eyes[:, 0].min() < front_m + NEAREST_M:
                continue
            layers = simulation.layers(eyes)
            if layers is not None:
                exact[row, column], expected[row, column] = simulation.seen_db(eyes, layers).values()
    return Volume(ANGLES_DEG, DISTANCES_M, exact, expected)


@dataclass(frozen=True, slots=True)
class Tolerance:
    """Carried PSNR over how far the eyes are from where the layers were made for."""

    offsets_mm: Sequence[float]
    psnr_db: F64  # (up, right): rows from the highest


def tolerance_map(simulation: Simulation, eyes_m: F64, offsets_mm: Sequence[float]) -> Tolerance:
    """Both eyes pooled, moved together to the right and up: carried (contracts), so that ghosts and fringes count."""
    layers = simulation.layers(eyes_m)
    table = np.full((len(offsets_mm), len(offsets_mm)), np.nan)
    if layers is None:
        return Tolerance(offsets_mm, table)
    drawn, fov_deg = simulation.pictures(eyes_m)
    right, up = stack_from_eye(eyes_m.mean(axis=0))[:3, 0], np.array([0.0, 0.0, 1.0])
    for row, up_mm in enumerate(reversed(offsets_mm)):
        for column, right_mm in enumerate(offsets_mm):
            table[row, column] = carried_quality(
                layers,
                drawn,
                simulation.stack,
                solved_for_m=eyes_m,
                eyes_m=eyes_m + (right_mm * right + up_mm * up) / 1000,
                fov_deg=fov_deg,
                step=MAP_STEP,
            ).psnr_db
    return Tolerance(offsets_mm, table)


@dataclass(frozen=True, slots=True)
class Curve:
    """One line of a plot."""

    name: str
    x: Sequence[float]
    y: Sequence[float]
    expected: Sequence[float] = ()  # the same as y, of eyes unsure by 1 mm


def over_gaps(scene: str, stack: PanelStack, models: Sequence[str], *, distance_m: float) -> list[Curve]:
    """Pooled PSNR over the distance between neighbouring panels; the viewer stays as far from the front one."""
    curves = []
    for model in models:
        exact, expected = [], []
        for gap_m in GAPS_M:
            spread = replace(stack, x_m=(-gap_m, 0.0, gap_m))
            eyes = eyes_at(distance_m=gap_m + distance_m)
            with Simulation(scene, spread, model=model) as simulation:
                layers = simulation.layers(eyes)
                seen = {0.0: math.nan, 1.0: math.nan} if layers is None else simulation.seen_db(eyes, layers)
                exact.append(seen[0.0])
                expected.append(seen[1.0])
        curves.append(Curve(model, [1000 * gap for gap in GAPS_M], exact, expected))
    return curves


@dataclass(frozen=True, slots=True)
class Size:
    """What a resolution of the panels costs and gives."""

    model: str
    width_px: int
    height_px: int
    ms: float
    psnr_db: float  # exact
    expected_db: float  # of eyes unsure by 1 mm


def over_resolutions(scene: str, stack: PanelStack, models: Sequence[str], *, distance_m: float) -> list[Size]:
    """Median time of a prediction (pictures drawn already) and pooled PSNR, for panels of fewer pixels."""
    sizes = []
    eyes = eyes_at(distance_m=distance_m)
    for factor in (0.25, 0.375, 0.5, 0.75, 1.0):
        small = replace(stack, width_px=round(stack.width_px * factor), height_px=round(stack.height_px * factor))
        for model in models:
            with Simulation(scene, small, model=model) as simulation:
                layers = simulation.layers(eyes)
                if layers is None:
                    continue
                rasters = simulation.predictor.rasters(eyes)
                blank = [np.full((r.height_px, r.width_px, 4), 128, np.uint8) for r in rasters]
                done = timed(partial(simulation.predictor.predict, [blank, blank], eyes), runs=7)
                seen = simulation.seen_db(eyes, layers)
                sizes.append(Size(model, small.width_px, small.height_px, done.median_ms, seen[0.0], seen[1.0]))
    return sizes


@dataclass(frozen=True, slots=True)
class Trade:
    """One model over the uncertainty of the eyes that it solves for: what eyes of each uncertainty see."""

    name: str
    solved_for_mm: Sequence[float]
    psnr_db: dict[float, list[float]]  # by how unsure the eyes really are, mm; 0: exact


def over_uncertainty(scene: str, stack: PanelStack, models: Sequence[str], *, distance_m: float) -> list[Trade]:
    """Exact and expected PSNR of every model over `eye_sigma_mm`."""
    eyes = eyes_at(distance_m=distance_m)
    trades = []
    for model in models:
        solved_for: list[float] = []
        told: dict[float, list[float]] = {sigma_mm: [] for sigma_mm in SEEN_WITH_MM}
        with Simulation(scene, stack, model=model) as simulation:
            for eye_sigma_mm in SOLVED_FOR_MM:
                layers = simulation.layers(eyes, eye_sigma_mm=eye_sigma_mm)
                if layers is None:
                    continue
                solved_for.append(eye_sigma_mm)
                values = simulation.seen_db(eyes, layers, sigmas_mm=SEEN_WITH_MM)
                for sigma_mm, value in values.items():
                    told[sigma_mm].append(value)
        trades.append(Trade(model, solved_for, told))
    return trades
