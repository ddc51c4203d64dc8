"""The two backends side by side: what each takes for a solution, step by step, and what crosses the bus."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from statistics import median
from time import perf_counter_ns
from typing import Any

from runtime.config import ModelSettings
from runtime.errors import MissingPart
from runtime.model.gl.backend import GlBackend
from runtime.model.gl.programs import Account
from runtime.model.opencv_surround import OpenCvBackend
from runtime.model.predictor import Predictor, load_predictor
from runtime.model.schedule import Backend
from runtime.optics.stack import PanelStack
from runtime.plan.drawing import drawn_for
from runtime.report.page import Section, Table
from runtime.report.pairs import Painter, eyes_at
from runtime.support.gl_sharing import LayerTextures, shared

DISTANCE_M, EYE_SIGMA_MM = 0.6, 3.0  # a tracker's eyes
RUNS = 5  # timed, after one that compiles and allocates; the backends take turns, so that both meet the same machine
STAGES = {
    "reduce and transform": ("wanted", "network"),
    "drive the outer panels": ("resample", "finer"),
    "correct them": (
        "residual",
        "residual_unsure",
        "back",
        "correct",
        "correct_unsure",
        "correct_at_once",
        "blur",
        "blur_both",
    ),
    "close the centre": ("close",),
}


@dataclass(frozen=True, slots=True)
class SideBySide:
    """One model, surrounded by OpenCV and by OpenGL, in one run."""

    model: str
    opencv_ms: float  # median of whole solutions, drawing included
    gl_ms: float
    passes: int  # of OpenGL, for one solution
    gpu_ms: dict[str, float]  # by timer queries, per stage
    crossing_bytes: dict[str, int]  # per backend, between GPU and processor, from drawn pictures to shown panels

    @property
    def times_as_many(self) -> float:
        """Solutions a second of OpenGL for one of OpenCV."""
        return self.opencv_ms / self.gl_ms


def side_by_side(models: Sequence[str], stack: PanelStack) -> tuple[str, list[SideBySide]]:
    """The OpenGL driver's name, and every model on the built-in scene. Raises MissingPart without OpenGL."""
    eyes_m, found = eyes_at(distance_m=DISTANCE_M), []
    with Painter("demo", stack) as painter:
        group = shared()
        gl = GlBackend(painter.context, stack, group=group)
        for model in models:
            loaded = load_predictor(model, stack, ModelSettings(name=model))
            other = loaded.on_panels(stack)
            assert other is not None
            predictors: dict[Backend, Predictor] = {OpenCvBackend(): loaded, gl: other}
            times: dict[str, list[float]] = {backend.name: [] for backend in predictors}
            for backend, predictor in predictors.items():
                predictor.surround_with(backend)
            for run in range(RUNS + 1):
                for backend, predictor in predictors.items():
                    begin_ns = perf_counter_ns()
                    images = drawn_for(predictor, painter.content, eyes_m, time_ns=0)
                    made = predictor.predict(images, eyes_m, eye_sigma_mm=EYE_SIGMA_MM).made
                    if run:
                        times[backend.name].append((perf_counter_ns() - begin_ns) / 1e6)
            stay = isinstance(made, LayerTextures)
            gl.passes.account = account = Account(timed=True)
            other.predict(drawn_for(other, painter.content, eyes_m, time_ns=0), eyes_m, eye_sigma_mm=EYE_SIGMA_MM)
            gl.passes.account = None
            found.append(
                SideBySide(
                    model,
                    median(times["opencv"]),
                    median(times["gl"]),
                    sum(not one.crosses for one in account.passes),
                    _by_stage(account),
                    _crossing(account, stack, stay=stay),
                )
            )
            for predictor in predictors.values():
                predictor.close()
        gl.close()
        renderer = gl.renderer
        if group is not None:
            group.close()
    return renderer, found


def _by_stage(account: Account) -> dict[str, float]:
    """Milliseconds by timer queries; every pass belongs to a stage."""
    stage_of = {name: stage for stage, names in STAGES.items() for name in names}
    total = dict.fromkeys(STAGES, 0.0)
    for one in account.passes:
        if not one.crosses:
            total[stage_of[one.name]] += one.gpu_ms or 0.0
    return total


def _crossing(account: Account, stack: PanelStack, *, stay: bool) -> dict[str, int]:
    """Bytes of one solution; OpenCV's: two pictures down, three layers up."""
    image = stack.width_px * stack.height_px * 4
    crossed = sum(one.read_bytes + one.written_bytes for one in account.passes if one.crosses)
    return {"opencv": (2 + stack.count) * image, "gl": crossed if stay else crossed + stack.count * image}


def backends_section(models: Sequence[str], stack: PanelStack) -> tuple[Section, dict[str, Any]]:
    """The section, and the same as a record."""
    title = "Around the network: OpenCV or OpenGL"
    try:
        renderer, found = side_by_side(models, stack)
    except MissingPart as error:
        return Section(title, [f"Not measured: {error}"]), {"missing": str(error)}
    text = [
        "One schedule, carried out on the processor or by fragment shaders: the same model, pictures and eyes, in turn "
        f"in one run. Drawing and the network, which both have, are within the ratio. OpenGL here: {renderer}.",
        f"Eyes {DISTANCE_M:g} m away that are unsure by {EYE_SIGMA_MM:g} mm, {stack.width_px}x{stack.height_px}. "
        "Stages are shares of the GPU's time by timer queries, which hold every pass up until it is complete.",
    ]
    rows = [
        [
            one.model,
            f"{one.times_as_many:.2f}",
            *(f"{100 * ms / max(sum(one.gpu_ms.values()), 1e-9):.0f} %" for ms in one.gpu_ms.values()),
            str(one.passes),
            *(f"{one.crossing_bytes[name] / 1e6:.1f}" for name in ("opencv", "gl")),
        ]
        for one in found
    ]
    headings = [
        "model", "solutions a second by OpenGL for one by OpenCV", *STAGES, "passes", "MB that cross, OpenCV",
        "MB that cross, OpenGL",
    ]  # fmt: skip
    record = {"renderer": renderer, "models": [asdict(one) | {"times_as_many": one.times_as_many} for one in found]}
    return Section(title, text, tables=[Table(headings, rows)]), record
