"""Measures what each saving of the plan saves and costs, here and for this scene."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from time import perf_counter_ns

import numpy as np

from runtime.content.base import ContentSource, View
from runtime.model.predictor import Predictor
from runtime.optics.quality import quality
from runtime.optics.retina import seen_by
from runtime.optics.stack import PanelStack
from runtime.optics.views import image_from_stack, raster_from_stack
from runtime.plan.planner import focused_part, observed
from runtime.plan.savings import Measured, Saving
from runtime.records import F32, F64, U8

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


def draw(content: ContentSource, predictor: Predictor, eyes_m: F64, *, time_ns: int, aim: bool = True) -> U8:
    """One frame's layers (N, h, w, 4), straight from content and model; the predictor's own array."""
    part = focused_part(predictor)
    if aim and part is not None:
        part.aim(content, eyes_m, time_ns=time_ns)
    images: list[list[U8]] = [[], []]
    rasters = predictor.rasters(eyes_m)
    for raster in rasters:
        for side, eye_m in enumerate(eyes_m):
            view = View(eye_m, side, raster_from_stack(eye_m, raster), raster.width_px, raster.height_px)
            picture = content.render(view, time_ns=time_ns)
            images[side].append(picture.copy() if len(rasters) > 1 else picture)
    return predictor.predict(images, eyes_m).layers


def displayed_psnr(
    layers: U8, content: ContentSource, eyes_m: F64, stack: PanelStack, *, fov_deg: float, time_ns: int
) -> float:
    """Pooled displayed PSNR of layers at eyes (2, 3)."""
    seen, wanted, masks = [], [], []
    for side, eye_m in enumerate(eyes_m):
        retina = seen_by(eye_m, layers, stack, fov_deg=fov_deg)
        size = {"width_px": stack.width_px, "height_px": stack.height_px}
        view = View(eye_m, side, image_from_stack(eye_m, fov_deg=fov_deg, **size), **size)
        target: F32 = content.render(view, time_ns=time_ns)[..., :3].astype(np.float32) / np.float32(255)
        seen.append(retina.image)
        wanted.append(target)
        masks.append(retina.mask)
    return quality(seen, wanted, masks).psnr_db


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
    times: dict[str, list[float]] = {name: [] for name in ways}
    layers: dict[str, U8] = {}
    for repeat in range(repeats + 1):
        for name, predictor in ways.items():
            begin_ns = perf_counter_ns()
            drawn = draw(content, predictor, eyes_m, time_ns=repeat * step_ns)
            if repeat:
                times[name].append((perf_counter_ns() - begin_ns) / 1e6)
            if repeat == repeats:
                layers[name] = drawn.copy()
    last_ns = repeats * step_ns
    return {
        name: Trial(
            layers[name],
            tuple(times[name]),
            displayed_psnr(layers[name], content, eyes_m, stack, fov_deg=fov_deg, time_ns=last_ns),
        )
        for name in ways
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
