"""What a moving viewer sees: simulated runs for every motion and several solver times."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from runtime.config import Settings, validated
from runtime.daemon.build import RunOptions, build_run, scaled_stack
from runtime.errors import FatalError
from runtime.evaluation.motion_recording import write_motion
from runtime.optics.carried import light_psnrs_db
from runtime.optics.light import Sampling
from runtime.records import F64, U8

MOTIONS = ("still", "lean", "walk", "stop-and-go")
SOLVER_MS = (33.0, 150.0)
SECONDS = 4.0
SETTLED_S = 1.0  # before it, the tracker has just begun
EVERY = 11  # refreshes from one that is looked at to the next: no multiple of a solution's refreshes for long
STEP = 2  # of the pixels that are compared
# How a solver's time is spread over its stages; only their sum matters here.
SHARES = {"render": 0.3, "prepare": 0.2, "inference": 0.1, "finish": 0.4}


@dataclass(frozen=True, slots=True)
class Moving:
    """One motion with a solver of some speed."""

    motion: str
    solver_ms: float
    light_db: float  # at the true eyes; mean over lights
    lights: int
    tracker_mm: tuple[float, float]  # p50 and p95 of how far the eyes were from where the tracker believed them
    behind_mm: float  # p50 of how far they were from where the layers had been solved for


class Watched:
    """Where a run's files would go: keeps them in memory."""

    def __init__(self) -> None:
        self.lines: list[Mapping[str, Any]] = []  # of frames.jsonl
        # Number of a refresh, its layers (N, h, w, 4), what the eyes solved for should see (h, w, 3 each), and where
        # eyes were: of refreshes of which all is known.
        self.lights: list[tuple[int, U8, tuple[U8, U8], Mapping[str, Any]]] = []

    def refresh(self, line: Mapping[str, Any]) -> None:
        self.lines.append(line)

    def light(self, frame: int, *, layers: U8, drawn: tuple[U8, U8] | None, info: Mapping[str, Any]) -> None:
        if drawn is not None and info["solved_for_m"] is not None and info["true_eyes_m"] is not None:
            self.lights.append((frame, layers, drawn, info))


def simulated_run(settings: Settings, *, scale: float, keep_light: int) -> Watched:
    """Run the daemon's loop on a recording on the simulated clock; keep_light: every so many refreshes.

    Raises FatalError.
    """
    watched = Watched()
    with ExitStack() as cleanup:
        options = RunOptions(max_speed=True, measure=False, scale=scale, keep_light=keep_light)
        run = build_run(settings, options, cleanup, output=watched)
        run.presenter.run()
        run.observer.finish()
    return watched


def settings_for(recording: Path, *, solver_ms: float) -> Settings:
    """The defaults, on a recording, with a solver that takes so long on the simulated clock."""
    table = Settings().model_dump()
    table["sensor"] |= {"driver": "replay", "source": str(recording), "loop": False}
    table["loop"]["simulated_stage_ms"] |= {stage: share * solver_ms for stage, share in SHARES.items()}
    return validated(Settings, table, source="settings")


def moving_run(motion: str, solver_ms: float, *, seconds: float = SECONDS, scale: float = 0.5, seed: int = 1) -> Moving:
    """Results of one motion with one solver, for its own process. Raises FatalError without any."""
    with tempfile.TemporaryDirectory(prefix="phasestack-") as folder:
        recording = Path(folder) / "motion.mcap"
        write_motion(recording, motion, seconds=seconds, seed=seed)
        settings = settings_for(recording, solver_ms=solver_ms)
        watched = simulated_run(settings, scale=scale, keep_light=EVERY)
    first = SETTLED_S * settings.loop.rate_hz
    where: Any = {"stack": scaled_stack(settings, scale), "fov_deg": settings.content.fov_deg}
    where |= {"sigmas_mm": (0.0,), "sampling": Sampling(step=STEP)}
    seen = []
    for _, layers, drawn, info in (light for light in watched.lights if light[0] >= first):
        where |= {"eyes_m": info["solved_for_m"], "seen_from_m": info["true_eyes_m"]}
        with contextlib.suppress(ValueError):  # they see nothing
            seen.append(light_psnrs_db(layers, drawn, **where)[0.0])
    lines = [line for line in watched.lines if line["frame"] >= first and line["true_eyes_m"] is not None]
    tracked, behind = (
        [_apart_mm(line[place], line["true_eyes_m"]) for line in lines if line[place] is not None]
        for place in ("eyes_m", "solved_for_m")
    )
    if not seen or not tracked or not behind:
        raise FatalError(f"the motion {motion} with a solver of {solver_ms:g} ms showed nothing")
    p50, p95 = map(float, np.percentile(tracked, (50, 95)))
    return Moving(motion, solver_ms, float(np.mean(seen)), len(seen), (p50, p95), float(np.median(behind)))


def _apart_mm(found_m: F64, truth_m: F64) -> float:
    return float(np.linalg.norm(found_m - truth_m, axis=1).mean() * 1000)
