"""Measure live quality for moving viewers in simulated runs, with fixed and with automatic efforts."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from runtime.config import Settings, validated
from runtime.daemon.build import RunOptions, build_run
from runtime.errors import FatalError
from runtime.evaluation.motion_recording import write_motion
from runtime.frame.kept_light import Output
from runtime.model.solver import REDUCTIONS
from runtime.records import Effort

SCENES = {"still": "demo", "lean": "demo", "walk": "demo", "stop-and-go": "demo", "film": "moving"}  # by motion
FULL = Effort(1, 4)  # full raster and all steps of the `balanced` model
FIXED = (FULL, Effort(1, 1), *(Effort(by, 0) for by in REDUCTIONS))
# Simulated times for a solution's stages on the full raster, as on a slow processor.
COSTS_MS = {"render": 44, "prepare": 40, "inference": 31, "finish": 38, "step": 85}
SECONDS, NOISE_MM, SEED = 6.0, 0.3, 5
EVERY = 23  # number of refreshes from one measured refresh to the next; not a multiple of the refreshes per solution


@dataclass(frozen=True, slots=True)
class Moving:
    """The result of one simulated run, for one motion with one effort."""

    motion: str
    effort: str  # name of a fixed effort, or `auto`
    live_db: float  # live quality (docs/contracts.md, Error)
    view_error_mm: tuple[float, float]  # p50 and p95 of the distance between the true eyes and the eyes solved for
    efforts: Mapping[str, float]  # seconds for which each effort's solutions were shown
    refreshes: int  # number of refreshes measured


def simulated_run(
    settings: Settings,
    *,
    scale: float,
    fixed: Effort | None = None,
    keep_light: int = 0,
    output: Output | None = None,
) -> dict[str, Any]:
    """Run against a simulated clock with a recording, measure live quality, and return the contents of
    summary.json. `scale` multiplies the panels' rows and columns; `fixed` is the effort if `model.effort` is `full`, by
    default all steps. The layers of every `keep_light`-th refresh, and the refreshes' records, go to `output`. Raises
    FatalError.
    """
    options = RunOptions(max_speed=True, measure=True, scale=scale, fixed=fixed, keep_light=keep_light)
    with ExitStack() as cleanup:
        run = build_run(settings, options, cleanup, output=output)
        run.observer.measure_only_live()
        run.presenter.run()
        run.observer.finish()
        return run.summary()


def settings_for(recording: Path, *, scene: str, effort: str) -> Settings:
    """Return settings for a simulated run of a recording, with the stage times of COSTS_MS."""
    table = Settings().model_dump()
    table["sensor"] |= {"driver": "replay", "source": str(recording), "loop": False}
    table["content"]["scene"] = scene
    table["loop"]["evaluate_every"] = EVERY
    table["loop"]["simulated_stage_ms"] |= COSTS_MS
    table["model"] |= {"effort": effort, "threads": 1}  # runs are parallel
    return validated(Settings, table, source="settings")


def moving_run(
    motion: str, effort: Effort | None, *, seconds: float = SECONDS, scale: float = 0.5, seed: int = SEED
) -> Moving:
    """Simulate a motion of SCENES by the viewer, or moving content in `film`, and measure what the viewer
    sees. Without an effort, the runtime chooses. `scale` multiplies rows and columns. Raises FatalError without a
    measurement.
    """
    with tempfile.TemporaryDirectory(prefix="phasestack-") as folder:
        recording = Path(folder) / "motion.mcap"
        head = "still" if motion == "film" else motion
        write_motion(recording, head, seconds=seconds, seed=seed, noise_mm=NOISE_MM)
        settings = settings_for(recording, scene=SCENES[motion], effort="full" if effort else "auto")
        summary = simulated_run(settings, scale=scale, fixed=effort)
    view_error_mm, live_db = summary["view_error_mm"], summary["live_db"]
    name = effort.name if effort else "auto"
    if view_error_mm is None or live_db is None:
        raise FatalError(f"the run with the motion {motion} and the effort {name} produced no measurement")
    both_mm = view_error_mm["p50"], view_error_mm["p95"]
    return Moving(motion, name, live_db, both_mm, summary["efforts"], summary["live_frames"])
