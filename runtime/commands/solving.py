"""The body of `phasestack solve`."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from runtime.config import ModelSettings, changed, load_settings, load_stack, with_options
from runtime.content.base import ContentInfo
from runtime.errors import EyesNotServed, InputError
from runtime.evaluation.displayed import Picture, displayed
from runtime.evaluation.solved import SolvedPair, judged
from runtime.evaluation.trials import Stopwatch, timed, timed_in_turn
from runtime.model.backends import choose
from runtime.model.job import Job
from runtime.model.predictor import Prediction, Predictor, load_predictor
from runtime.model.steps import SolverBackend
from runtime.model.still import solve_still
from runtime.model.trim import Savings, Scene, trim
from runtime.optics.stack import PanelStack
from runtime.plan.savings import Measured, Saving, network_items
from runtime.records import F64, U8, PlanItem
from runtime.support.artifacts import OutputFolder, in_8_bits, read_picture, write_json

SEPARATION_MIN_M = 0.005
MEASURED_FROM = 10  # runs that are worth a look at which backend is faster
COMPARED = 3  # timed runs with and without the plan


@dataclass(frozen=True, slots=True)
class SolveOptions:
    """The command line of `solve`."""

    left: Path
    right: Path
    left_eye: tuple[float, float, float]
    right_eye: tuple[float, float, float]
    fov_deg: float
    panels: Path
    out: Path
    model: str
    repeat: int
    eye_sigma_mm: float
    config: Path | None
    backend: str | None = None
    no_plan: bool = False


def solve_pair(request: SolveOptions) -> dict[str, Any]:
    """Layers, what the eyes see of them, and solve.json (docs/contracts.md). Raises InputError."""
    clock = Stopwatch()
    settings = with_options(load_settings(request.config), backend=request.backend)
    if request.no_plan:
        settings = changed(settings, "plan", {"enabled": False}, source="--no-plan")
    model_settings = settings.model
    cv2.setNumThreads(model_settings.threads or -1)
    stored = [read_picture(path) for path in (request.left, request.right)]
    pictures = [in_8_bits(picture) for picture in stored]
    if pictures[0].shape != pictures[1].shape:
        sizes = " and ".join(f"{p.shape[1]}x{p.shape[0]}" for p in pictures)
        raise InputError(request.right, "size", f"the two pictures differ: {sizes}")
    height, width = pictures[0].shape[:2]
    stack = load_stack(request.panels, width_px=width, height_px=height)
    eyes_m = checked_eyes(request.left_eye, request.right_eye, stack)
    model_settings = model_settings.model_copy(update={"name": request.model})
    settings = settings.model_copy(update={"model": model_settings})
    clock.ended("read pictures")
    predictor = load_predictor(model_settings.name, stack, model_settings)
    with ExitStack() as contexts, ExitStack() as cleanup:
        cleanup.callback(predictor.close)
        backend = _backend(model_settings, predictor, request, contexts)
        predictor.set_backend(backend)
        clock.ended("load model")
        solver = PairSolver(pictures, eyes_m, request, predictor)
        prediction, timing = _timed(solver, trimmed=settings.plan.enabled and predictor.trims)
        clock.ended("solve, warm-up included")
        with OutputFolder(request.out) as folder:
            pair = _judged(prediction.layers, stored, solver)
            where = f"{request.left.name} and {request.right.name}, model {request.model}, solved for eyes unsure by "
            where += f"{request.eye_sigma_mm:g} mm; one ray a pixel, as published: {pair.quality.psnr_db:.1f} dB"
            pair.write(folder.staging, lines=[where])
            clock.ended("measure and write")
            plan = _left_out(solver, stored, pair.quality.psnr_db)
            clock.ended("compare with the plan off")
            named = {
                "model": predictor.name,
                "provider": predictor.provider,
                "backend": predictor.backend,
                "eye_sigma_mm": request.eye_sigma_mm,
                "steps": prediction.steps,
                "plan": [asdict(item) for item in plan],
            }
            result = pair.quality.table() | timing | named | {"wall_s": clock.seconds}
            write_json(folder.staging / "solve.json", result)
    return result


def _backend(
    settings: ModelSettings, predictor: Predictor, request: SolveOptions, contexts: ExitStack
) -> SolverBackend:
    """What surrounds the network: one solution is sooner made than two backends are measured.

    contexts: releases what was made, once nothing uses it any more.
    """

    def context() -> Any:
        from runtime.support.gl import offscreen_context

        made = offscreen_context()
        contexts.callback(made.release)
        return made

    wanted = settings.backend
    if wanted == "auto" and request.repeat < MEASURED_FROM:
        wanted = "cpu"
    return choose(wanted, predictor, context).backend


class PairSolver:
    """Both pictures of the command line, solved with what they do not need left out, or not."""

    def __init__(self, pictures: list[U8], eyes_m: F64, options: SolveOptions, predictor: Predictor) -> None:
        self.pictures, self.eyes_m, self.options, self.predictor = pictures, eyes_m, options, predictor
        self.left_out = Savings()  # of the newest trimmed job

    def solved(self, changed: Callable[[Job], Job] = lambda job: job) -> Prediction:
        """changed: the job that is solved instead. Raises InputError for eyes that the model does not serve: here they
        will not move on."""
        try:
            return solve_still(
                *self.pictures,
                eyes_m=self.eyes_m,
                fov_deg=self.options.fov_deg,
                predictor=self.predictor,
                eye_sigma_mm=self.options.eye_sigma_mm,
                changed=changed,
            )
        except EyesNotServed as error:
            raise InputError(
                "solve",
                "--left-eye, --right-eye",
                f"{error}: {self.predictor.name} can't serve them (try --model sart)",
            ) from None

    def trimmed(self, job: Job) -> Job:
        """What the pictures need of a job."""
        job, self.left_out = trim(job, Scene(self.predictor.stack))
        return job


def _left_out(solver: PairSolver, stored: Sequence[Picture], planned_db: float) -> list[PlanItem]:
    """What was left out of these pictures, and what that saved and cost against a model that leaves out nothing.

    stored: the same pictures in their files' own bits, which is what the eyes should see.
    All ways are timed again, in turn, so that what slows one slows the others.
    """
    left_out, options, stack = solver.left_out, solver.options, solver.predictor.stack
    numbers, info = Measured(left_out=left_out), ContentInfo(options.left.name)
    if not network_items(info, numbers):
        return []
    calls: dict[str, Callable[[int], U8]] = {
        "plain": lambda _: solver.solved().layers,
        "planned": lambda _: solver.solved(solver.trimmed).layers,
    }
    middle = "plain" if left_out.channels == 3 else "planned"  # in colour, or of the whole, one saving is all there is
    if left_out.channels == 1 and left_out.solved_share < 1:
        middle = "between"
        calls[middle] = lambda _: solver.solved(lambda job: replace(job, channels=1)).layers
    done = timed_in_turn(calls, runs=COMPARED, keep=lambda layers: layers.copy())
    shown_db = {
        name: planned_db
        if name == "planned"
        else displayed(
            way.answer, stored, stack, eyes_m=solver.eyes_m, fov_deg=options.fov_deg, similarity=False
        ).quality.psnr_db
        for name, way in done.items()
    }

    def saving(without: str, with_it: str) -> Saving:
        return Saving(done[without].median_ms - done[with_it].median_ms, shown_db[without] - shown_db[with_it])

    return network_items(info, replace(numbers, one_channel=saving("plain", middle), focus=saving(middle, "planned")))


def checked_eyes(left_eye: tuple[float, ...], right_eye: tuple[float, ...], stack: PanelStack) -> F64:
    """(2, 3) eyes that can be served. Raises InputError, naming the option."""
    for option, eye in (("--left-eye", left_eye), ("--right-eye", right_eye)):
        if not all(math.isfinite(value) for value in eye):
            raise InputError("solve", option, "must be three finite numbers")
        if eye[0] <= max(stack.x_m):
            raise InputError("solve", option, f"x = {eye[0]:g} m : not in front of the panels (x > {max(stack.x_m):g})")
    separation_m = math.dist(left_eye, right_eye)
    if separation_m < SEPARATION_MIN_M:
        raise InputError("solve", "--right-eye", f"is {separation_m * 1e3:g} mm from the left one; 5 mm is the least")
    return np.array([left_eye, right_eye])


def _timed(solver: PairSolver, *, trimmed: bool) -> tuple[Prediction, dict[str, float]]:
    """A warm-up, then `repeat` timed runs; medians."""
    inference_ms: list[float] = []

    def solved() -> Prediction:
        prediction = solver.solved(solver.trimmed) if trimmed else solver.solved()
        inference_ms.append(prediction.stage_ms["inference"])
        return prediction

    repeat = solver.options.repeat
    done = timed(solved, runs=repeat)
    return done.answer, {
        "inference_ms": round(float(np.median(inference_ms[-repeat:])), 3),
        "total_ms": round(done.median_ms, 3),
    }


def _judged(layers: U8, pictures: Sequence[Picture], solver: PairSolver) -> SolvedPair:
    """What the eyes see, and what they should see. Raises InputError where they see nothing."""
    stack, fov_deg = solver.predictor.stack, solver.options.fov_deg
    try:
        return judged(layers, pictures, stack, eyes_m=solver.eyes_m, fov_deg=fov_deg)
    except ValueError as error:
        raise InputError("solve", "--left-eye", f"{error}: nothing of the display can be seen from there") from None
