"""What the plan saves and costs over scenes of every kind, and what a frame costs as the active region grows.

With and without the plan take turns, frame by frame, so that whatever slows the machine slows both; what is
claimed are ratios of such turns.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from runtime.clock import NS_PER_S
from runtime.config import Settings
from runtime.content import shapes
from runtime.content.procedural import ProceduralSource
from runtime.content.scenes import Scene, Thing, scene
from runtime.model.predictor import load_predictor
from runtime.optics.stack import PanelStack
from runtime.plan.measure import Trial, measure, trials
from runtime.plan.planner import focused_part
from runtime.plan.predictors import planned_predictor
from runtime.plan.savings import network_items
from runtime.records import F64

SCENES = {
    "sparse": "sparse object on white",
    "texture": "full-frame texture",
    "grey": "grey",
    "flat": "flat, in the panel's plane",
    "thin": "thin depth",
    "moving": "moving content",
}
STEP_NS = NS_PER_S // 60
REGIONS = (0.06, 0.12, 0.2, 0.3, 0.4, 0.5, 0.65, 0.8, 1.0)  # of the panel's height, that a square card fills
QUICK_REGIONS = (0.06, 0.2, 0.4, 1.0)
SIZES = (1.0, 0.5)  # of the panels, in columns and rows: cost must follow the active pixels, not these


@dataclass(frozen=True, slots=True)
class SceneResult:
    """One scene with and without the plan."""

    name: str
    kind: str
    frames: int
    ms_with: float  # a frame, median: render and predict
    ms_without: float
    ms_with_p99: float
    ms_without_p99: float
    faster: float  # median over pairs of frames drawn one after the other
    db_with: float
    db_without: float
    active_fraction: float
    channels: int
    left_out: tuple[dict[str, Any], ...]


@dataclass(frozen=True, slots=True)
class RegionResult:
    """One size of the active region on panels of one size."""

    width_px: int
    height_px: int
    active_px: int
    ms_with: float
    ms_without: float
    share: float  # of the time without the plan, median over pairs of frames drawn one after the other


def others() -> Iterator[tuple[str, Scene]]:
    """Small objects that are not the sparse scene's: other shapes, places, depths and sizes."""
    demo, ring = scene("demo").things, scene("sparse").things[0]
    yield "ring, behind and left", Scene("ring-left", (replace(ring, centre_m=(-0.03, -0.12, -0.05)),))
    yield "ring, before and right", Scene("ring-right", (replace(ring, centre_m=(0.04, 0.13, 0.05)),))
    yield "globe, 30% of the height", Scene("globe", (replace(demo[3], shape=shapes.sphere(0.044)),))
    yield "crate, 20% of the height", Scene("crate", (replace(demo[4], shape=shapes.box((0.04,) * 3)),))


def survey_scenes(
    settings: Settings,
    stack: PanelStack,
    context: Any,
    eyes_m: F64,
    *,
    repeats: int,
    progress: Callable[[str], None] = lambda _: None,
) -> tuple[list[SceneResult], list[SceneResult]]:
    """The six scenes, and small objects of other kinds, each with the plan and without. eyes_m: (2, 3)."""
    plain = load_predictor(settings.model.name, stack, settings.model)
    planned = planned_predictor(settings, stack)
    cases = [(kind, scene(name)) for name, kind in SCENES.items()]
    results: list[list[SceneResult]] = []
    try:
        for group in (cases, list(others())):
            done = []
            for kind, case in group:
                progress(case.name)
                content = ProceduralSource(case, stack=stack, context=context, background=settings.content.background)
                try:
                    numbers, without, with_plan = measure(
                        content,
                        plain,
                        planned,
                        eyes_m,
                        stack,
                        fov_deg=settings.content.fov_deg,
                        band_m=0.0,
                        step_ns=STEP_NS,
                        repeats=repeats,
                    )
                    items = [
                        {"what": i.what, "why": i.why, "saves_ms": i.saves_ms, "costs_db": i.costs_db}
                        for i in network_items(content.info, numbers)
                    ]
                finally:
                    content.close()
                done.append(
                    _result(case.name, kind, without, with_plan, numbers.active_fraction, numbers.channels, items)
                )
            results.append(done)
    finally:
        plain.close()
        planned.close()
    return results[0], results[1]


def survey_regions(
    settings: Settings,
    stack: PanelStack,
    context: Any,
    eyes_m: F64,
    *,
    regions: tuple[float, ...] = REGIONS,
    repeats: int,
    progress: Callable[[str], None] = lambda _: None,
) -> list[RegionResult]:
    """A textured card that grows, on panels of two sizes, with the plan and without. eyes_m: (2, 3)."""
    results = []
    for size in SIZES:
        panels = replace(stack, width_px=round(stack.width_px * size), height_px=round(stack.height_px * size))
        plain = load_predictor(settings.model.name, panels, settings.model)
        planned = planned_predictor(settings, panels)
        try:
            for region in regions:
                progress(f"a card of {region:.0%} of the height, {panels.width_px} x {panels.height_px}")
                content = ProceduralSource(card(region), stack=panels, context=context)
                try:
                    ways = {"plain": plain, "planned": planned}
                    fov_deg = settings.content.fov_deg
                    done = trials(content, ways, eyes_m, panels, fov_deg=fov_deg, repeats=repeats)
                finally:
                    content.close()
                part = focused_part(planned)
                fraction = part.active_fraction if part else 1.0
                active_px = round(fraction * panels.width_px * panels.height_px)
                results.append(
                    RegionResult(
                        panels.width_px,
                        panels.height_px,
                        active_px,
                        done["planned"].frame_ms,
                        done["plain"].frame_ms,
                        float(np.median(np.array(done["planned"].times_ms) / np.array(done["plain"].times_ms))),
                    )
                )
        finally:
            plain.close()
            planned.close()
    return results


def card(share: float) -> Scene:
    """A textured square, turned a little and before the panels, `share` of the display's height."""
    side_m = 0.2916 * share
    turned = shapes.rotation_about(2, np.radians(15.0))
    square = shapes.card(side_m, side_m, repeat=(4.0 * share, 4.0 * share))
    return Scene("card", (Thing(square, "mosaic", (0.02, 0.0, 0.0), rotation=turned, lit=False),))


def _result(
    name: str,
    kind: str,
    without: Trial,
    with_plan: Trial,
    active_fraction: float,
    channels: int,
    items: list[dict[str, Any]],
) -> SceneResult:
    ratios = np.array(without.times_ms) / np.array(with_plan.times_ms)
    return SceneResult(
        name=name,
        kind=kind,
        frames=len(with_plan.times_ms),
        ms_with=round(with_plan.frame_ms, 2),
        ms_without=round(without.frame_ms, 2),
        ms_with_p99=round(float(np.percentile(with_plan.times_ms, 99)), 2),
        ms_without_p99=round(float(np.percentile(without.times_ms, 99)), 2),
        faster=round(float(np.median(ratios)), 3),
        db_with=round(with_plan.psnr_db, 3),
        db_without=round(without.psnr_db, 3),
        active_fraction=round(active_fraction, 4),
        channels=channels,
        left_out=tuple(items),
    )
