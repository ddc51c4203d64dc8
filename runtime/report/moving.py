"""Live quality for moving viewers: simulated runs for every motion and several solver times."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from runtime.config import Settings, validated
from runtime.daemon.build import RunOptions, build_run
from runtime.errors import FatalError
from runtime.evaluation.motion_recording import write_motion
from runtime.evaluation.refresh_quality import view_error_mm
from runtime.optics.quality import psnr_db
from runtime.records import U8

MOTIONS = ("still", "lean", "walk", "stop-and-go")
SOLVER_MS = (33.0, 150.0)
SECONDS = 4.0
SETTLED_S = 1.0  # start of the run that is skipped: the tracker has just begun
EVERY = 11  # refreshes between samples: not a multiple of a solution's refreshes
# Shares of a solver's stages in its time; only their sum matters here.
SHARES = {"render": 0.3, "prepare": 0.2, "inference": 0.1, "finish": 0.4}


@dataclass(frozen=True, slots=True)
class Moving:
    """One motion with a solver of some speed."""

    motion: str
    solver_ms: float
    live_db: float  # docs/contracts.md, Error
    refreshes: int  # measured
    tracker_mm: tuple[float, float]  # p50 and p95, true eyes to those that the tracker predicted
    view_error_mm: tuple[float, float]  # p50 and p95, true eyes to those that the layers were solved for


class Lines:
    """Output of a run that keeps the lines of frames.jsonl in memory."""

    def __init__(self) -> None:
        self.lines: list[Mapping[str, Any]] = []

    def refresh(self, line: Mapping[str, Any]) -> None:
        self.lines.append(line)

    def light(self, frame: int, *, layers: U8) -> None:
        """Keep no layers."""

    def light_targets(self, frame: int, **targets: Any) -> None:
        """Keep no pictures."""


def simulated_run(settings: Settings, *, scale: float) -> tuple[list[Mapping[str, Any]], dict[int, float]]:
    """Lines of frames.jsonl, and live errors by refresh, of a simulated run. Raises FatalError."""
    output = Lines()
    with ExitStack() as cleanup:
        run = build_run(settings, RunOptions(max_speed=True, measure=True, scale=scale), cleanup, output=output)
        run.observer.measure_only_live()
        run.presenter.run()
        run.observer.finish()
    return output.lines, run.observer.live_errors


def settings_for(recording: Path, *, solver_ms: float) -> Settings:
    """Default settings for a recording, with a solver that takes `solver_ms` on the simulated clock."""
    table = Settings().model_dump()
    table["sensor"] |= {"driver": "replay", "source": str(recording), "loop": False}
    table["loop"]["evaluate_every"] = EVERY
    table["model"]["effort"] = "full"  # the solver takes as long as is said
    table["loop"]["simulated_stage_ms"] |= {stage: share * solver_ms for stage, share in SHARES.items()}
    return validated(Settings, table, source="settings")


def moving_run(motion: str, solver_ms: float, *, seconds: float = SECONDS, scale: float = 0.5) -> Moving:
    """Run one motion with one solver, in a separate process. Raises FatalError without any result."""
    with tempfile.TemporaryDirectory(prefix="phasestack-") as folder:
        recording = Path(folder) / "motion.mcap"
        write_motion(recording, motion, seconds=seconds, seed=1)
        settings = settings_for(recording, solver_ms=solver_ms)
        lines, errors = simulated_run(settings, scale=scale)
    first = SETTLED_S * settings.loop.rate_hz
    live = [error for frame, error in errors.items() if frame >= first]
    known = [line for line in lines if line["frame"] >= first and line["true_eyes_m"] is not None]
    tracked_mm, stale_mm = (
        [view_error_mm(line["true_eyes_m"], line[eyes]) for line in known if line[eyes] is not None]
        for eyes in ("eyes_m", "solved_for_m")
    )
    if not live or not tracked_mm or not stale_mm:
        raise FatalError(f"the motion {motion} with a solver of {solver_ms:g} ms gave no measurement")
    live_db = psnr_db(float(np.mean(live)))
    return Moving(motion, solver_ms, live_db, len(live), _quantiles(tracked_mm), _quantiles(stale_mm))


def _quantiles(values: list[float]) -> tuple[float, float]:
    p50, p95 = map(float, np.percentile(values, (50, 95)))
    return p50, p95
