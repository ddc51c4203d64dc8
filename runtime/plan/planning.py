"""Puts content and models together to measure a plan."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from rich.console import Console

from runtime.config import Settings, load_settings, validated
from runtime.content.registry import open_content
from runtime.errors import FatalError, InputError
from runtime.model.backends import choose
from runtime.model.predictor import load_predictor
from runtime.optics.retina import seen_by
from runtime.plan.ladder import rungs
from runtime.plan.levels import BudgetKeeper, QualityLevel, useful
from runtime.plan.measure import measure, trial
from runtime.plan.planner import focused_part
from runtime.plan.predictors import planned_predictor
from runtime.plan.reduced import ladder_predictor
from runtime.plan.savings import Saving, make_plan
from runtime.support.gl import offscreen_context
from runtime.support.progress import NowAndThen

if TYPE_CHECKING:
    from runtime.content.base import ContentSource
    from runtime.model.schedule import Backend
    from runtime.optics.stack import PanelStack
    from runtime.plan.levels import QualityLevel
    from runtime.plan.measure import Trial
    from runtime.records import F64

MIDDLE_M = (0.6, 0.0, 0.05)
HALF_IPD_M = 0.031


def plan_for(
    config: Path | None,
    *,
    scene: str | None,
    model: str | None,
    scale: float,
    budget_ms: float | None,
    middle_m: tuple[float, float, float] | None,
    quiet: bool,
) -> dict[str, Any]:
    """Measure and plan one scene; everything that `phasestack plan` prints. Raises PhasestackError."""
    settings = overridden(load_settings(config), scene=scene, model=model, budget_ms=budget_ms)
    cv2.setNumThreads(settings.model.threads or -1)
    stack = settings.stack.stack()
    stack = replace(
        stack, width_px=max(16, round(stack.width_px * scale)), height_px=max(16, round(stack.height_px * scale))
    )
    middle = np.array(MIDDLE_M if middle_m is None else middle_m)
    half = np.array([0.0, HALF_IPD_M, 0.0])
    eyes_m = np.array([middle - half, middle + half])
    where = "plan: --eyes"
    if settings.sensor.fixed_eyes_m is not None and middle_m is None:
        eyes_m, where = np.array(settings.sensor.fixed_eyes_m), "sensor.fixed_eyes_m"
    _check_viewer(eyes_m, stack, fov_deg=settings.content.fov_deg, source=where)
    with ExitStack() as cleanup:
        tell = teller(cleanup, quiet)
        context = offscreen_context()
        cleanup.callback(context.release)
        content = open_content(settings.content, stack, context, limits=settings.limits)
        cleanup.callback(content.close)
        plain = load_predictor(settings.model.name, stack, settings.model)
        cleanup.callback(plain.close)
        tell("backend")
        backend = choose(settings.model.backend, plain, lambda: context).backend
        cleanup.callback(backend.close)
        predictor = planned_predictor(settings, stack)
        for surrounded in (plain, predictor):
            cleanup.callback(surrounded.close)  # before its backend
            surrounded.surround_with(backend)
        tell("with and without the plan")
        numbers, without, with_plan = measure(
            content, plain, predictor, eyes_m, stack, fov_deg=settings.content.fov_deg, band_m=_band_m(settings)
        )
        levels: list[QualityLevel] = []
        if settings.model.budget_ms > 0:
            levels, numbers, with_plan = _budget(
                settings, stack, content, eyes_m, numbers, with_plan, tell, backend=backend
            )
        planned = make_plan(
            content.info,
            stack,
            settings,
            eyes_m=eyes_m,
            measured=numbers,
            can_focus=focused_part(predictor) is not None,
            loaded_modules=sys.modules,
        )
        drift_db = numbers.reuse.costs_db if planned.reuse and not content.info.moving else None
        return {
            "scene": content.info.name,
            "model": plain.name,
            "backend": plain.backend,
            "width_px": stack.width_px,
            "height_px": stack.height_px,
            "plan": [asdict(item) for item in planned.items],
            "active_fraction": round(numbers.active_fraction, 4),
            "channels": numbers.channels,
            "frame_ms": round(with_plan.frame_ms, 2),
            "frame_ms_without": round(without.frame_ms, 2),
            "psnr_db": round(with_plan.psnr_db, 3),
            "psnr_db_without": round(without.psnr_db, 3),
            "drift_mm": round(1000 * _band_m(settings), 3),
            "psnr_db_drifted": None if drift_db is None else round(with_plan.psnr_db - drift_db, 3),
            "level": numbers.level,
            "levels": [
                {"label": level.label, "ms": round(level.expected_ms, 2), "psnr_db": round(level.psnr_db, 3)}
                for level in levels
            ],
        }


def _budget(
    settings: Settings,
    stack: PanelStack,
    content: ContentSource,
    eyes_m: F64,
    numbers: Any,
    present: Trial,
    tell: Callable[[str], None],
    *,
    backend: Backend,
) -> tuple[list[QualityLevel], Any, Trial]:
    """Measure what the running daemon would choose from (`ladder.rungs`), and choose by the budget.

    Raises FatalError where no level can be had.
    """
    trials: dict[str, Trial] = {}
    levels = []
    for name, scale in rungs(settings, stack):
        level = QualityLevel(name, scale, 0.0, 0.0)
        tell(level.label)
        try:
            predictor = ladder_predictor(name, scale, stack, settings)
        except FatalError:  # a network of fixed size has no smaller ones
            continue
        try:
            predictor.surround_with(backend)
            result = trial(content, predictor, eyes_m, stack, fov_deg=settings.content.fov_deg, repeats=3)
        finally:
            predictor.close()
        trials[level.label] = result
        levels.append(replace(level, expected_ms=result.frame_ms, psnr_db=result.psnr_db))
    if not levels:
        raise FatalError("budget: no model can be had in any size")
    levels = useful(levels)
    keeper = BudgetKeeper(levels, settings.model.budget_ms)
    saving = Saving(present.frame_ms - keeper.level.expected_ms, present.psnr_db - keeper.level.psnr_db)
    numbers = replace(numbers, level=keeper.level.label, level_saving=saving)
    return levels, numbers, trials[keeper.level.label]


def _check_viewer(eyes_m: F64, stack: PanelStack, *, fov_deg: float, source: str) -> None:
    """Raise InputError, naming the option, for eyes (2, 3) from which nothing of the display can be seen."""
    nearest_m = float(eyes_m[:, 0].min())
    if nearest_m <= max(stack.x_m):
        raise InputError(source, "", f"x = {nearest_m:g} m : not in front of the panels (x > {max(stack.x_m):g} m)")
    # Few pixels tell as much: the same rays at a coarser raster.
    coarse = replace(stack, width_px=64, height_px=36)
    blank = np.zeros((stack.count, coarse.height_px, coarse.width_px, 3), np.uint8)
    if not any(seen_by(eye_m, blank, coarse, fov_deg=fov_deg).mask.any() for eye_m in eyes_m):
        raise InputError(source, "", "nothing of the display can be seen from there")


def _band_m(settings: Settings) -> float:
    return (settings.plan.dead_band_mm or settings.plan.most_band_mm) / 1000


def overridden(settings: Settings, *, scene: str | None, model: str | None, budget_ms: float | None) -> Settings:
    """Settings with what the command line says."""
    table = settings.model_dump()
    for section, name, value, option in (
        ("content", "scene", scene, "--scene"),
        ("model", "name", model, "--model"),
        ("model", "budget_ms", budget_ms, "--budget-ms"),
    ):
        if value is not None:
            table[section][name] = value
            validated(Settings, table, source=option)
    return validated(Settings, table, source="settings")


def teller(cleanup: ExitStack, quiet: bool) -> Callable[[str], None]:
    """Shows what is being measured, on stderr."""
    if quiet:
        return lambda text: None
    if not sys.stderr.isatty():
        told = NowAndThen(sys.stderr)
        return lambda text: told(f"measuring: {text}")

    status = cleanup.enter_context(Console(stderr=True).status("loading"))
    return lambda text: status.update(f"measuring: {text}")
