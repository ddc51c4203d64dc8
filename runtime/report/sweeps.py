"""Quality over one thing at a time: place of the viewer, error of the tracker, gap, resolution, tolerance knob."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from runtime.evaluation.trials import timed
from runtime.optics.stack import PanelStack
from runtime.optics.views import stack_from_eye
from runtime.records import F64
from runtime.report.pairs import beside, eyes_at
from runtime.report.simulate import Simulation

ANGLES_DEG = tuple(range(-70, 71, 10))
DISTANCES_M = (0.1, 0.15, 0.25, 0.4, 0.6, 0.9, 1.4, 2.0, 3.0, 4.0)
GAPS_M = (0.005, 0.01, 0.02, 0.03, 0.06, 0.1, 0.2, 0.5)
NEAREST_M = 0.03  # before the front panel; nearer eyes are left blank


@dataclass(frozen=True, slots=True)
class Volume:
    """Displayed PSNR over where the viewer is."""

    angles_deg: Sequence[float]
    distances_m: Sequence[float]
    psnr_db: F64  # (distances, angles), NaN where there is no picture


def viewing_volume(simulation: Simulation) -> Volume:
    """Both eyes' pooled PSNR with the eyes' own layers, at every place."""
    table = np.full((len(DISTANCES_M), len(ANGLES_DEG)), np.nan)
    front_m = max(simulation.stack.x_m)
    for row, distance_m in enumerate(DISTANCES_M):
        for column, angle_deg in enumerate(ANGLES_DEG):
            eyes = eyes_at(distance_m=distance_m, angle_deg=angle_deg)
            if eyes[:, 0].min() < front_m + NEAREST_M:
                continue
            layers = simulation.layers(eyes)
            if layers is not None:
                table[row, column] = simulation.pooled_db(eyes, layers)
    return Volume(ANGLES_DEG, DISTANCES_M, table)


@dataclass(frozen=True, slots=True)
class Tolerance:
    """Displayed PSNR over how far the eyes are from where the layers were made for."""

    offsets_mm: Sequence[float]
    psnr_db: F64  # (up, right): rows from the highest


def tolerance_map(simulation: Simulation, eyes_m: F64, offsets_mm: Sequence[float]) -> Tolerance:
    """The mean over both eyes, moved together parallel to their own image planes."""
    layers = simulation.layers(eyes_m)
    table = np.full((len(offsets_mm), len(offsets_mm)), np.nan)
    if layers is None:
        return Tolerance(offsets_mm, table)
    poses = [stack_from_eye(eye) for eye in eyes_m]
    for row, up_mm in enumerate(reversed(offsets_mm)):
        for column, right_mm in enumerate(offsets_mm):
            places = [p[:3, 3] + (right_mm * p[:3, 0] + up_mm * p[:3, 1]) / 1000 for p in poses]
            table[row, column] = np.mean([simulation.psnr_db(place, layers) for place in places])
    return Tolerance(offsets_mm, table)


@dataclass(frozen=True, slots=True)
class Curve:
    """One line of a plot."""

    name: str
    x: Sequence[float]
    y: Sequence[float]
    marks: Sequence[str] = ()  # what stands beside each dot


def over_gaps(scene: str, stack: PanelStack, models: Sequence[str], *, distance_m: float) -> list[Curve]:
    """Pooled PSNR over the distance between neighbouring panels; the viewer stays as far from the front one."""
    curves = []
    for model in models:
        values = []
        for gap_m in GAPS_M:
            spread = replace(stack, x_m=(-gap_m, 0.0, gap_m))
            eyes = eyes_at(distance_m=gap_m + distance_m)
            with Simulation(scene, spread, model=model) as simulation:
                layers = simulation.layers(eyes)
                values.append(math.nan if layers is None else simulation.pooled_db(eyes, layers))
        curves.append(Curve(model, [1000 * gap for gap in GAPS_M], values))
    return curves


@dataclass(frozen=True, slots=True)
class Size:
    """What a resolution of the panels costs and gives."""

    model: str
    width_px: int
    height_px: int
    ms: float
    psnr_db: float


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
                sizes.append(
                    Size(
                        model,
                        small.width_px,
                        small.height_px,
                        done.median_ms,
                        simulation.pooled_db(eyes, layers),
                    )
                )
    return sizes


def over_uncertainty(
    scene: str, stack: PanelStack, models: Sequence[str], *, distance_m: float, off_mm: float = 2.0
) -> list[Curve]:
    """Over the uncertainty that is solved for: PSNR at the eyes (x) against PSNR beside them (y), a point a setting."""
    eyes = eyes_at(distance_m=distance_m)
    curves = []
    for model in models:
        exact, beside_db, marks = [], [], []
        with Simulation(scene, stack, model=model) as simulation:
            for eye_sigma_mm in (0.0, 0.5, 1.0, 2.0, 4.0, 8.0):
                layers = simulation.layers(eyes, eye_sigma_mm=eye_sigma_mm)
                if layers is None:
                    continue
                exact.append(simulation.pooled_db(eyes, layers))
                marks.append(f"{eye_sigma_mm:g}")
                places = [place for eye in eyes for place in beside(eye, off_mm)]
                beside_db.append(float(np.mean([simulation.psnr_db(place, layers) for place in places])))
        curves.append(Curve(model, exact, beside_db, marks))
    return curves
