"""Measures what each saving of the plan saves and costs, here and for this scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter_ns

import numpy as np

from runtime.content.base import ContentSource, View
from runtime.content.plan import Measured, Saving
from runtime.focus import FocusedPredictor
from runtime.model.predictor import Predictor
from runtime.optics.quality import quality
from runtime.optics.retina import seen_by
from runtime.optics.stack import PanelStack
from runtime.optics.views import image_from_stack, raster_from_stack
from runtime.planner import focused_part
from runtime.records import F32, F64, U8

REPEATS = 5


@dataclass(frozen=True, slots=True)
class Trial:
    """One way of making the layers."""

    layers: U8
    frame_ms: float  # render and predict, median
    psnr_db: float


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


def trial(
    content: ContentSource,
    predictor: Predictor,
    eyes_m: F64,
    stack: PanelStack,
    *,
    fov_deg: float,
    time_ns: int = 0,
    repeats: int = REPEATS,
) -> Trial:
    """Time and displayed quality of one predictor on one scene; the first frame is not timed."""
    draw(content, predictor, eyes_m, time_ns=time_ns)
    times = []
    for _ in range(repeats):
        begin_ns = perf_counter_ns()
        layers = draw(content, predictor, eyes_m, time_ns=time_ns)
        times.append((perf_counter_ns() - begin_ns) / 1e6)
    kept = layers.copy()
    psnr_db = displayed_psnr(kept, content, eyes_m, stack, fov_deg=fov_deg, time_ns=time_ns)
    return Trial(kept, float(np.median(times)), psnr_db)


def measure(
    content: ContentSource,
    whole: Predictor,
    focused: FocusedPredictor | None,
    eyes_m: F64,
    stack: PanelStack,
    *,
    fov_deg: float,
    band_m: float,
    repeats: int = REPEATS,
    progress: Callable[[str], None] = lambda _: None,
) -> Measured:
    """Each saving with and without, for eyes (2, 3). band_m: the widest dead band."""
    progress("the whole panel")
    plain = trial(content, whole, eyes_m, stack, fov_deg=fov_deg, repeats=repeats)
    best, fraction, focus = plain, 1.0, Saving()
    if focused is not None:
        progress("the active window")
        best = trial(content, focused, eyes_m, stack, fov_deg=fov_deg, repeats=repeats)
        fraction = focused.active_fraction
        focus = Saving(plain.frame_ms - best.frame_ms, plain.psnr_db - best.psnr_db)
    progress("eyes within the dead band")
    moved = eyes_m + np.array([0.0, band_m, 0.0])
    off_db = displayed_psnr(best.layers, content, moved, stack, fov_deg=fov_deg, time_ns=0)
    reuse = Saving(best.frame_ms, best.psnr_db - off_db)
    return Measured(reuse=reuse, focus=focus, active_fraction=fraction)
