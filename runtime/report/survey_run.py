"""`phasestack plan --survey`: measures it, and leaves table, plots and JSON."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from runtime.config import load_settings
from runtime.plan.planning import HALF_IPD_M, MIDDLE_M, overridden, teller
from runtime.plan.survey import QUICK_REGIONS, REGIONS, survey_regions, survey_scenes
from runtime.report.survey_page import write_survey
from runtime.support.artifacts import OutputFolder
from runtime.support.gl import offscreen_context

SURVEY_REPEATS = 15


def survey(
    config: Path | None, *, out: Path, model: str | None, scale: float, quick: bool, quiet: bool
) -> dict[str, Any]:
    """Six kinds of scenes, other small objects and growing regions, with the plan and without; files in `out`.

    Raises PhasestackError; leaves nothing new then.
    """
    settings = overridden(load_settings(config), scene=None, model=model, budget_ms=None)
    cv2.setNumThreads(settings.model.threads or -1)
    stack = settings.stack.stack()
    scale *= 0.5 if quick else 1.0
    stack = replace(
        stack, width_px=max(16, round(stack.width_px * scale)), height_px=max(16, round(stack.height_px * scale))
    )
    half = np.array([0.0, HALF_IPD_M, 0.0])
    eyes_m = np.array([np.array(MIDDLE_M) - half, np.array(MIDDLE_M) + half])
    with ExitStack() as cleanup, OutputFolder(out) as folder:
        tell = teller(cleanup, quiet)
        context = offscreen_context()
        cleanup.callback(context.release)
        repeats = SURVEY_REPEATS // 3 if quick else SURVEY_REPEATS
        scenes, others = survey_scenes(settings, stack, context, eyes_m, repeats=repeats, progress=tell)
        regions = survey_regions(
            settings,
            stack,
            context,
            eyes_m,
            regions=QUICK_REGIONS if quick else REGIONS,
            repeats=max(3, repeats // 3),
            progress=tell,
        )
        facts = {
            "model": settings.model.name,
            "width_px": stack.width_px,
            "height_px": stack.height_px,
            "threads": settings.model.threads,
            "eyes_m": eyes_m.tolist(),
            "date": datetime.now(UTC).strftime("%Y-%m-%d"),
        }
        return write_survey(folder.staging, scenes, others, regions, facts)
