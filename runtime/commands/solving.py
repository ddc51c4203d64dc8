"""The body of `phasestack solve`."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from runtime.clock import Stopwatch
from runtime.config import Settings, load_stack, with_options
from runtime.content.base import ContentInfo
from runtime.errors import EyesNotServed, InputError
from runtime.evaluation.displayed import Picture, displayed
from runtime.evaluation.solved import judged
from runtime.evaluation.trials import timed, timed_in_turn
from runtime.model.backends import choose
from runtime.model.job import Job
from runtime.model.predictor import Prediction, Predictor, load_predictor
from runtime.model.still import solve_still
from runtime.model.trim import Savings, Scene, trim
from runtime.optics.stack import PanelStack
from runtime.plan.savings import Measured, Saving, network_items
from runtime.records import F64, U8, PlanItem
from runtime.support.artifacts import OutputFolder, in_8_bits, read_picture, write_json
from runtime.support.gl import offscreen_context

SEPARATION_MIN_M = 0.005
MEASURED_FROM = 10  # runs that are worth a look at which backend is faster
COMPARED = 3  # timed runs with and without the plan


def solve_pair(
    files: tuple[Path, Path],
    eyes: tuple[tuple[float, ...], tuple[float, ...]],
    panels: Path,
    out: Path,
    *,
    fov_deg: float,
    model: str,
    repeat: int,
    eye_sigma_mm: float,
    backend: str | None,
    plan: bool,
) -> dict[str, Any]:
    """Layers, what the eyes see of them, and solve.json (docs/contracts.md). Raises InputError."""
    watch = Stopwatch()
    settings = with_options(Settings(), model=model, backend=backend).model
    cv2.setNumThreads(settings.threads)
    stored = [read_picture(path) for path in files]
    pictures = [in_8_bits(picture) for picture in stored]
    if pictures[0].shape != pictures[1].shape:
        sizes = " and ".join(f"{p.shape[1]}x{p.shape[0]}" for p in pictures)
        raise InputError(files[1], "size", f"the two pictures differ: {sizes}")
    stack = load_stack(panels, width_px=pictures[0].shape[1], height_px=pictures[0].shape[0])
    eyes_m = checked_eyes(*eyes, stack)
    watch.lap("read pictures")
    with ExitStack() as contexts, ExitStack() as cleanup:

        def context() -> Any:
            made = offscreen_context()
            contexts.callback(made.release)
            return made

        predictor = load_predictor(model, stack, settings)
        cleanup.callback(predictor.close)
        # One solution is sooner made than two backends are measured.
        wanted = "cpu" if settings.backend == "auto" and repeat < MEASURED_FROM else settings.backend
        predictor.set_backend(choose(wanted, predictor, context).backend)
        watch.lap("load model")
        pair = _Pair(pictures, stored, eyes_m, fov_deg, eye_sigma_mm, predictor)
        inference_ms: list[float] = []

        def solve_timed() -> Prediction:
            prediction = pair.solve(pair.trim if plan and predictor.trims else None)
            inference_ms.append(prediction.stage_ms["inference"])
            return prediction

        done = timed(solve_timed, runs=repeat)
        watch.lap("solve, warm-up included")
        with OutputFolder(out) as folder:
            try:
                seen = judged(done.answer.layers, stored, stack, eyes_m=eyes_m, fov_deg=fov_deg)
            except ValueError as error:
                why = f"{error}: nothing of the display can be seen from there"
                raise InputError("solve", "--left-eye", why) from None
            line = (
                f"{files[0].name} and {files[1].name}, model {model}, solved for eyes unsure by {eye_sigma_mm:g} mm; "
            )
            line += f"one ray a pixel, as published: {seen.quality.psnr_db:.1f} dB"
            seen.write(folder.staging, lines=[line])
            watch.lap("measure and write")
            left_out = pair.price(ContentInfo(files[0].name), planned_db=seen.quality.psnr_db)
            watch.lap("compare with the plan off")
            result = seen.quality.table() | {
                "inference_ms": round(float(np.median(inference_ms[-repeat:])), 3),
                "total_ms": round(done.median_ms, 3),
                "model": predictor.name,
                "provider": predictor.provider,
                "backend": predictor.backend,
                "eye_sigma_mm": eye_sigma_mm,
                "steps": done.answer.steps,
                "plan": [asdict(item) for item in left_out],
                "wall_s": {part: round(ms / 1e3, 3) for part, ms in watch.stage_ms.items()},
            }
            write_json(folder.staging / "solve.json", result)
    return result


@dataclass
class _Pair:
    """Two pictures for two eyes, solved with what they do not need left out, or not."""

    pictures: Sequence[U8]
    stored: Sequence[Picture]  # the same in their files' own bits: what the eyes should see
    eyes_m: F64
    fov_deg: float
    eye_sigma_mm: float
    predictor: Predictor
    left_out: Savings = field(default_factory=Savings)  # of the newest trimmed job

    def solve(self, changed: Callable[[Job], Job] | None = None) -> Prediction:
        """changed: the job that is solved instead. Raises InputError for eyes that the model does not serve."""
        try:
            return solve_still(
                *self.pictures,
                eyes_m=self.eyes_m,
                fov_deg=self.fov_deg,
                predictor=self.predictor,
                eye_sigma_mm=self.eye_sigma_mm,
                changed=changed or (lambda job: job),
            )
        except EyesNotServed as error:  # here they will not move on
            why = f"{error}: {self.predictor.name} can't serve them (try --model sart)"
            raise InputError("solve", "--left-eye, --right-eye", why) from None

    def trim(self, job: Job) -> Job:
        """What the pictures need of a job."""
        job, self.left_out = trim(job, Scene(self.predictor.stack))
        return job

    def price(self, info: ContentInfo, *, planned_db: float) -> list[PlanItem]:
        """What was left out, and what that saved and cost against a model that leaves out nothing.

        All ways are timed again, in turn, so that what slows one slows the others.
        """
        left_out = self.left_out
        numbers = Measured(left_out=left_out)
        if not network_items(info, numbers):
            return []
        ways: dict[str, Callable[[Job], Job] | None] = {"plain": None, "planned": self.trim}
        # In colour, or of the whole, one saving is all there is.
        middle = "plain" if left_out.channels == 3 else "planned"
        if left_out.channels == 1 and left_out.solved_share < 1:
            middle = "between"
            ways[middle] = lambda job: replace(job, channels=1)

        def call(changed: Callable[[Job], Job] | None) -> Callable[[], U8]:
            return lambda: self.solve(changed).layers

        calls = {name: call(changed) for name, changed in ways.items()}
        done = timed_in_turn(calls, runs=COMPARED)
        shown_db = {name: self._psnr_db(way.answer) for name, way in done.items() if name != "planned"}
        shown_db["planned"] = planned_db

        def saving(without: str, with_it: str) -> Saving:
            return Saving(done[without].median_ms - done[with_it].median_ms, shown_db[without] - shown_db[with_it])

        return network_items(
            info, replace(numbers, one_channel=saving("plain", middle), focus=saving(middle, "planned"))
        )

    def _psnr_db(self, layers: U8) -> float:
        stack, eyes_m, fov_deg = self.predictor.stack, self.eyes_m, self.fov_deg
        views = displayed(layers, self.stored, stack, eyes_m=eyes_m, fov_deg=fov_deg, similarity=False)
        return views.quality.psnr_db


def checked_eyes(left_eye: tuple[float, ...], right_eye: tuple[float, ...], stack: PanelStack) -> F64:
    """(2, 3) eyes that can be served. Raises InputError, naming the option."""
    for option, eye in (("--left-eye", left_eye), ("--right-eye", right_eye)):
        if eye[0] <= max(stack.x_m):
            raise InputError("solve", option, f"x = {eye[0]:g} m : not in front of the panels (x > {max(stack.x_m):g})")
    separation_m = math.dist(left_eye, right_eye)
    if separation_m < SEPARATION_MIN_M:
        raise InputError("solve", "--right-eye", f"is {separation_m * 1e3:g} mm from the left one; 5 mm is the least")
    return np.array([left_eye, right_eye])
