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
from runtime.eyes.motions import MOTIONS
from runtime.optics.carried import CarriedView, carried_quality
from runtime.optics.retina import as_codes
from runtime.optics.stack import PanelStack
from runtime.records import F64, U8

SOLVER_MS = (20.0, 75.0, 150.0, 300.0)
SECONDS = 5.0
SETTLED_S = 1.0  # before it, the tracker has just begun
EVERY = 11  # refreshes from one that is looked at to the next: no multiple of a solution's refreshes for long
STRIP_MOTION, STRIP_SOLVER_MS, STRIP_EVERY, STRIP_LENGTH = "lean", 150.0, 13, 4
QUICK: dict[str, Any] = {
    "motions": ("still", "lean", "walk", "stop-and-go"),
    "solver_ms": (33.0, 150.0, 300.0),
    "seconds": 4.0,
}
STEP = 2  # of the rays that are compared
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
class Watched:
    """A run that was looked at."""

    summary: Mapping[str, Any]
    lines: Sequence[Mapping[str, Any]]  # of frames.jsonl
    values: Sequence[Any]  # what `measure` answered, light by light


@dataclass(frozen=True, slots=True)
class Moving:
    """One motion with one solver, aligned or held."""

    motion: str
    solver_ms: float
    aligned: bool
    carried_db: float  # at the true eyes; mean over lights
    lights: int
    tracker_mm: tuple[float, float]  # p50 and p95 of how far the eyes were from where the tracker believed them
    behind_mm: float  # p50 of how far they were from where the layers had been solved for


@dataclass(frozen=True, slots=True)
class Strip:
    """The left eye's view, light by light: (frames, h, w, 3) code values, and both eyes' carried dB."""

    motion: str
    solver_ms: float
    seconds: Sequence[float]
    wanted: U8
    held: U8
    held_db: Sequence[float]
    aligned: U8
    aligned_db: Sequence[float]


class _Lights:
    """Where a run's files would go: looks at each light as it comes, so that none is kept."""

    def __init__(self, measure: Callable[[Light], Any]) -> None:
        self._measure = measure
        self.lines: list[Mapping[str, Any]] = []
        self.values: list[Any] = []

    def refresh(self, line: Mapping[str, Any]) -> None:
        self.lines.append(line)

    def light(self, frame: int, *, layers: U8, drawn: tuple[U8, U8] | None, info: Mapping[str, Any]) -> None:
        if drawn is not None and info["solved_for_m"] is not None and info["true_eyes_m"] is not None:
            self.values.append(self._measure(Light(frame, layers, drawn, info["solved_for_m"], info["true_eyes_m"])))


def simulated_run(settings: Settings, *, scale: float, keep_light: int, measure: Callable[[Light], Any]) -> Watched:
    """The daemon's own loop on a recording, on the simulated clock, to its end; `measure` is given every kept light.

    keep_light: refreshes from one to the next. Raises FatalError.
    """
    lights = _Lights(measure)
    with ExitStack() as cleanup:
        options = RunOptions(max_speed=True, scale=scale, keep_light=keep_light)
        run = build_run(settings, options, cleanup, output=lights)
        run.presenter.run()
        run.observer.finish()
        return Watched(run.summary(), lights.lines, lights.values)


def settings_for(recording: Path, *, solver_ms: float, aligned: bool, scene: str = "demo") -> Settings:
    """The defaults, on a recording, with a solver that takes so long on the simulated clock."""
    table = Settings().model_dump()
    table["sensor"] |= {"driver": "replay", "source": str(recording), "loop": False}
    table["content"]["scene"] = scene
    table["plan"]["align"] = aligned
    table["loop"]["simulated_stage_ms"] |= {stage: share * solver_ms for stage, share in SHARES.items()}
    return validated(Settings, table, source="settings")


def record_motion(path: Path, motion: str, *, seconds: float, seed: int) -> None:
    """A head that moves as the tracker's benchmark has it, with its true eyes."""
    write_motion(path, motion, seconds=seconds, seed=seed)


def moving_runs(
    *,
    motions: Sequence[str] = tuple(MOTIONS),
    solver_ms: Sequence[float] = SOLVER_MS,
    seconds: float = SECONDS,
    scale: float = 0.5,
    seed: int = 1,
    scene: str = "demo",
) -> tuple[list[Moving], Strip]:
    """Every motion over the solver's time, held and aligned; and what one of them looks like.

    Runs one after the other; meant for a process of its own. Raises FatalError where one shows nothing.
    """
    stack = _stack(scale)
    found = []
    with tempfile.TemporaryDirectory(prefix="phasestack-") as folder:
        for motion in motions:
            recording = Path(folder) / f"{motion}.mcap"
            record_motion(recording, motion, seconds=seconds, seed=seed)
            for took_ms in solver_ms:
                for aligned in (False, True):
                    settings = settings_for(recording, solver_ms=took_ms, aligned=aligned, scene=scene)
                    fov_deg = settings.content.fov_deg
                    watched = simulated_run(
                        settings, scale=scale, keep_light=EVERY, measure=partial(_carried, stack=stack, fov_deg=fov_deg)
                    )
                    found.append(_judged(watched, motion, took_ms, aligned=aligned))
        return found, _strip(Path(folder), stack, scale=scale, seed=seed, scene=scene)


def _stack(scale: float) -> PanelStack:
    return scaled_stack(Settings(), scale)


def _carried(light: Light, *, stack: PanelStack, fov_deg: float) -> tuple[int, float]:
    try:
        quality = carried_quality(
            light.layers,
            light.drawn,
            stack,
            solved_for_m=light.solved_for_m,
            eyes_m=light.true_eyes_m,
            fov_deg=fov_deg,
            step=STEP,
        )
    except ValueError:  # nothing of the display is seen from there
        return light.frame, float("nan")
    return light.frame, quality.psnr_db


def _judged(watched: Watched, motion: str, solver_ms: float, *, aligned: bool) -> Moving:
    first = SETTLED_S * Settings().loop.rate_hz
    values = [value for frame, value in watched.values if frame >= first and np.isfinite(value)]
    lines = [line for line in watched.lines if line["frame"] >= first and line["true_eyes_m"] is not None]
    tracked = [_apart_mm(line["eyes_m"], line["true_eyes_m"]) for line in lines if line["eyes_m"] is not None]
    behind = [
        _apart_mm(line["solved_for_m"], line["true_eyes_m"]) for line in lines if line["solved_for_m"] is not None
    ]
    if not values or not tracked or not behind:
        raise FatalError(f"the motion {motion} with a solver of {solver_ms:g} ms showed nothing")
    p50, p95 = np.percentile(tracked, (50, 95))
    return Moving(
        motion,
        solver_ms,
        aligned,
        float(np.mean(values)),
        len(values),
        (float(p50), float(p95)),
        float(np.median(behind)),
    )


def _apart_mm(found_m: F64, truth_m: F64) -> float:
    return float(np.linalg.norm(np.asarray(found_m) - np.asarray(truth_m), axis=1).mean() * 1000)


def _strip(folder: Path, stack: PanelStack, *, scale: float, seed: int, scene: str) -> Strip:
    """A few refreshes of one run, as the left eye sees them: held and aligned."""
    recording = folder / "strip.mcap"
    record_motion(recording, STRIP_MOTION, seconds=4.0, seed=seed)
    views: dict[bool, list[tuple[int, U8, U8, float]]] = {}
    for aligned in (False, True):
        settings = settings_for(recording, solver_ms=STRIP_SOLVER_MS, aligned=aligned, scene=scene)
        fov_deg = settings.content.fov_deg

        def view(light: Light, fov_deg: float = fov_deg) -> tuple[int, U8, U8, float]:
            height, width = light.drawn[0].shape[:2]
            seen = CarriedView(light.solved_for_m[0], stack, width_px=width, height_px=height, fov_deg=fov_deg)
            shown = seen.seen_from(light.true_eyes_m[0], light.layers)
            picture = as_codes(np.where(shown.mask[..., None], shown.image, np.float32(0.94)))
            return light.frame, light.drawn[0].copy(), picture, _carried(light, stack=stack, fov_deg=fov_deg)[1]

        watched = simulated_run(settings, scale=scale, keep_light=STRIP_EVERY, measure=view)
        rate_hz = settings.loop.rate_hz
        kept = [value for value in watched.values if value[0] >= SETTLED_S * rate_hz and np.isfinite(value[3])]
        views[aligned] = kept[:STRIP_LENGTH]
    held, now = views[False], views[True]
    count = min(len(held), len(now))
    if count == 0:
        raise FatalError("the film strip showed nothing")
    return Strip(
        STRIP_MOTION,
        STRIP_SOLVER_MS,
        [frame / rate_hz for frame, *_ in held[:count]],
        np.stack([wanted for _, wanted, _, _ in held[:count]]),
        np.stack([picture for *_, picture, _ in held[:count]]),
        [value for *_, value in held[:count]],
        np.stack([picture for *_, picture, _ in now[:count]]),
        [value for *_, value in now[:count]],
    )
