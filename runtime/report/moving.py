"""What a viewer who moves sees: the product's own runs in simulated time, for every motion, over the solver's time."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from runtime.config import Settings, validated
from runtime.daemon.build import RunOptions, build_run, scaled_stack
from runtime.errors import FatalError
from runtime.evaluation.motion_recording import write_motion
from runtime.optics.carried import expected_psnrs_db, light_psnrs_db
from runtime.optics.stack import PanelStack
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
class Light:
    """What the panels showed at one refresh, and to whom."""

    frame: int
    layers: U8  # (N, h, w, 4)
    drawn: tuple[U8, U8]  # (h, w, 3) what the eyes solved for should see
    solved_for_m: F64  # (2, 3)
    true_eyes_m: F64  # (2, 3)


@dataclass(frozen=True, slots=True)
class Moving:
    """One motion with a solver of some speed."""

    motion: str
    solver_ms: float
    light_db: float  # at the true eyes; mean over lights
    one_ray_db: float
    lights: int
    tracker_mm: tuple[float, float]  # p50 and p95 of how far the eyes were from where the tracker believed them
    behind_mm: float  # p50 of how far they were from where the layers had been solved for


class Watched:
    """Where a run's files would go: looks at each light as it comes, so that none is kept."""

    def __init__(self, measure: Callable[[Light], Any]) -> None:
        self._measure = measure
        self.lines: list[Mapping[str, Any]] = []  # of frames.jsonl
        self.values: list[Any] = []  # what `measure` answered, light by light
        self.summary: Mapping[str, Any] = {}

    def refresh(self, line: Mapping[str, Any]) -> None:
        self.lines.append(line)

    def light(self, frame: int, *, layers: U8, drawn: tuple[U8, U8] | None, info: Mapping[str, Any]) -> None:
        if drawn is not None and info["solved_for_m"] is not None and info["true_eyes_m"] is not None:
            self.values.append(self._measure(Light(frame, layers, drawn, info["solved_for_m"], info["true_eyes_m"])))


def simulated_run(
    settings: Settings, *, scale: float, keep_light: int, measure: Callable[[Light], Any], quality: bool = False
) -> Watched:
    """The daemon's own loop on a recording, on the simulated clock, to its end; `measure` is given every kept light.

    keep_light: refreshes from one to the next; quality: the summary has the run's own decibels. Raises FatalError.
    """
    watched = Watched(measure)
    with ExitStack() as cleanup:
        options = RunOptions(max_speed=True, measure=quality, scale=scale, keep_light=keep_light)
        run = build_run(settings, options, cleanup, output=watched)
        run.presenter.run()
        run.observer.finish()
        watched.summary = run.summary()
    return watched


def settings_for(recording: Path, *, solver_ms: float) -> Settings:
    """The defaults, on a recording, with a solver that takes so long on the simulated clock."""
    table = Settings().model_dump()
    table["sensor"] |= {"driver": "replay", "source": str(recording), "loop": False}
    table["loop"]["simulated_stage_ms"] |= {stage: share * solver_ms for stage, share in SHARES.items()}
    return validated(Settings, table, source="settings")


def moving_run(motion: str, solver_ms: float, *, seconds: float = SECONDS, scale: float = 0.5, seed: int = 1) -> Moving:
    """One motion with one solver. Meant for a process of its own. Raises FatalError where it shows nothing."""
    with tempfile.TemporaryDirectory(prefix="phasestack-") as folder:
        recording = Path(folder) / "motion.mcap"
        write_motion(recording, motion, seconds=seconds, seed=seed)
        settings = settings_for(recording, solver_ms=solver_ms)
        look = partial(_carried, stack=scaled_stack(settings, scale), fov_deg=settings.content.fov_deg)
        watched = simulated_run(settings, scale=scale, keep_light=EVERY, measure=look)
    return _judged(watched, motion, solver_ms, rate_hz=settings.loop.rate_hz)


def _carried(light: Light, *, stack: PanelStack, fov_deg: float) -> tuple[int, float, float]:
    """The refresh, and what the true eyes see of it: light, and one ray a pixel. NaN where they see nothing."""
    where: Any = {"eyes_m": light.solved_for_m, "seen_from_m": light.true_eyes_m, "sigmas_mm": (0.0,)}
    where |= {"fov_deg": fov_deg, "step": STEP}
    try:
        seen = [way(light.layers, light.drawn, stack, **where)[0.0] for way in (light_psnrs_db, expected_psnrs_db)]
    except ValueError:
        return light.frame, float("nan"), float("nan")
    return light.frame, seen[0], seen[1]


def _judged(watched: Watched, motion: str, solver_ms: float, *, rate_hz: float) -> Moving:
    first = SETTLED_S * rate_hz
    seen = np.array([value[1:] for value in watched.values if value[0] >= first and np.isfinite(value[1])])
    lines = [line for line in watched.lines if line["frame"] >= first and line["true_eyes_m"] is not None]
    tracked, behind = (
        [_apart_mm(line[place], line["true_eyes_m"]) for line in lines if line[place] is not None]
        for place in ("eyes_m", "solved_for_m")
    )
    if not len(seen) or not tracked or not behind:
        raise FatalError(f"the motion {motion} with a solver of {solver_ms:g} ms showed nothing")
    light_db, one_ray_db = map(float, seen.mean(axis=0))
    p50, p95 = map(float, np.percentile(tracked, (50, 95)))
    return Moving(motion, solver_ms, light_db, one_ray_db, len(seen), (p50, p95), float(np.median(behind)))


def _apart_mm(found_m: Sequence[Any] | F64, truth_m: Sequence[Any] | F64) -> float:
    return float(np.linalg.norm(np.asarray(found_m) - np.asarray(truth_m), axis=1).mean() * 1000)
