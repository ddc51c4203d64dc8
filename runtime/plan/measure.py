"""Measures what each saving of the plan saves and costs, here and for this scene."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from runtime.content.base import ContentSource
from runtime.evaluation.displayed import displayed
from runtime.evaluation.trials import timed_in_turn
from runtime.model.predictor import Predictor
from runtime.optics.stack import PanelStack
from runtime.plan.drawing import drawn_for, retina_pictures
from runtime.plan.planner import focused_part, observed
from runtime.plan.savings import Measured, Saving
from runtime.records import F64, U8

REPEATS = 5


@dataclass(frozen=True, slots=True)
class Trial:
    """One way of making the layers."""

    layers: U8
    times_ms: tuple[float, ...]  # render and predict, frame by frame
    psnr_db: float

    @property
    def frame_ms(self) -> float:
        """Of the median frame."""
        return float(np.median(self.times_ms))


def draw(content: ContentSource, predictor: Predictor, eyes_m: F64, *, time_ns: int) -> U8:
    """One frame's layers (N, h, w, 4), straight from content and model; the predictor's own array."""
    return predictor.predict(drawn_for(predictor, content, eyes_m, time_ns=time_ns), eyes_m).layers


def displayed_psnr(
    layers: U8, content: ContentSource, eyes_m: F64, stack: PanelStack, *, fov_deg: float, time_ns: int
) -> float:
    """Pooled displayed PSNR of layers at eyes (2, 3)."""
    wanted = retina_pictures(content, eyes_m, stack, fov_deg=fov_deg, time_ns=time_ns)
    return displayed(layers, wanted, stack, eyes_m=eyes_m, fov_deg=fov_deg, similarity=False).quality.psnr_db


def trials(
    content: ContentSource,
    ways: Mapping[str, Predictor],
    eyes_m: F64,
    stack: PanelStack,
    *,
    fov_deg: float,
    step_ns: int = 0,
    repeats: int = REPEATS,
) -> dict[str, Trial]:
    """Time and displayed quality of several predictors on one scene, in turn: what slows one slows all.

    The first frame of each is not timed. step_ns: between one repeat and the next, for content that moves.
    """

    def frames(predictor: Predictor) -> Callable[[int], U8]:
        return lambda run: draw(content, predictor, eyes_m, time_ns=run * step_ns)

    calls = {name: frames(predictor) for name, predictor in ways.items()}
    done = timed_in_turn(calls, runs=repeats, keep=lambda layers: layers.copy())
    last_ns = repeats * step_ns
    return {
        name: Trial(
            way.answer,
            way.times_ms,
            displayed_psnr(way.answer, content, eyes_m, stack, fov_deg=fov_deg, time_ns=last_ns),
        )
        for name, way in done.items()
    }


def trial(
    content: ContentSource, predictor: Predictor, eyes_m: F64, stack: PanelStack, *, fov_deg: float, repeats: int
) -> Trial:
    """Time and displayed quality of one predictor on one scene."""
    return trials(content, {"": predictor}, eyes_m, stack, fov_deg=fov_deg, repeats=repeats)[""]


def measure(
    content: ContentSource,
    plain: Predictor,
    planned: Predictor,
    eyes_m: F64,
    stack: PanelStack,
    *,
    fov_deg: float,
    band_m: float,
    step_ns: int = 0,
    repeats: int = REPEATS,
) -> tuple[Measured, Trial, Trial]:
    """Each saving with and without, for eyes (2, 3); and the trials without and with the plan.

    plain: the model without savings; planned: the same with them; band_m: the widest dead band.
    """
    draw(content, planned, eyes_m, time_ns=0)
    part = focused_part(planned)
    ways: dict[str, Predictor] = {"plain": plain, "planned": planned}
    if planned.channels == 1 and part is not None:
        ways["one channel"] = part.whole
    done = trials(content, ways, eyes_m, stack, fov_deg=fov_deg, step_ns=step_ns, repeats=repeats)
    without, with_plan = done["plain"], done["planned"]
    unfocused = done.get("one channel", with_plan if part is None else without)
    moved = eyes_m + np.array([0.0, band_m, 0.0])
    off_db = displayed_psnr(with_plan.layers, content, moved, stack, fov_deg=fov_deg, time_ns=repeats * step_ns)
    numbers = Measured(
        reuse=Saving(with_plan.frame_ms, with_plan.psnr_db - off_db),
        focus=_saving(unfocused, with_plan),
        one_channel=_saving(without, unfocused),
    )
    return observed(numbers, planned), without, with_plan


def _saving(without: Trial, with_it: Trial) -> Saving:
    return Saving(without.frame_ms - with_it.frame_ms, without.psnr_db - with_it.psnr_db)
