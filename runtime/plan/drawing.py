"""Draw the target pictures for a solution. Only this module combines content, views and models."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from runtime.content.base import ContentSource, View
from runtime.errors import ContextLost, PhasestackError
from runtime.model.job import Job, SolveWindow, Targets, drawn_views
from runtime.model.predictor import Predictor
from runtime.model.trim import extent_window, trim
from runtime.optics.rect import PixelRect, union
from runtime.optics.relief import COARSE_RIM_PX, RIM_PX, block_px, relief_of
from runtime.optics.stack import PanelStack, PlaneRaster
from runtime.optics.views import image_from_stack, raster_from_stack
from runtime.records import F32, F64, U8, Eyes
from runtime.support.gl import DrawnPicture


def raster_views(eyes_m: Eyes, raster: PlaneRaster, *, reduction: int = 1) -> tuple[View, ...]:
    """Return each eye's view, used to draw content on a raster, usually the middle panel's.

    `reduction` is the panels' number of rows and columns, divided by the raster's.
    """
    return tuple(
        View(eye, n % 2, raster_from_stack(eye, raster), raster.width_px, raster.height_px, reduction)
        for n, eye in enumerate(eyes_m)
    )


def retina_view(eye_m: F64, side: int, *, width_px: int, height_px: int, fov_deg: float) -> View:
    """Return the view of an eye that looks at the stack's origin; side 0 is left, 1 right."""
    projection = image_from_stack(eye_m, width_px=width_px, height_px=height_px, fov_deg=fov_deg)
    return View(eye_m, side, projection, width_px, height_px)


def retina_pictures(
    content: ContentSource, eyes_m: Eyes, stack: PanelStack, *, fov_deg: float, time_ns: int
) -> tuple[U8, ...]:
    """Draw the (h, w, 3) pictures that eyes looking at the origin should see, with a panel's pixels."""
    size = {"width_px": stack.width_px, "height_px": stack.height_px}
    views = [retina_view(eye, n % 2, **size, fov_deg=fov_deg) for n, eye in enumerate(eyes_m)]
    pictures: list[U8] = []
    for first in range(0, len(views), 2):
        pair = views[first : first + 2]
        content.expect(pair, time_ns=time_ns)
        pictures += [np.ascontiguousarray(content.render(view, time_ns=time_ns)[..., :3]) for view in pair]
    return tuple(pictures)


def drawn_job(
    predictor: Predictor,
    content: ContentSource,
    eyes_m: Eyes,
    *,
    time_ns: int,
    reduction: int = 1,
    trimmed: bool = False,
    before: SolveWindow | None = None,
    in_depth: bool = False,
) -> Job:
    """Draw content for both eyes on the middle panel's pixels, reduced, and return a job with the two
    pictures.

    Pictures that the content draws with OpenGL stay in textures if the model can read them. `trimmed` skips work that
    the scene does not need, even drawing outside a known extent; `before` is the previous window on this raster.
    `in_depth` includes relief, if the depth is known. Raises ContentFailure if drawing fails, and ContextLost.
    """
    stack, trimmed = predictor.stack.reduced(reduction), trimmed and predictor.facts.trims
    window: SolveWindow | None = None
    raster = stack.panel(stack.count // 2)
    if trimmed and content.info.background is not None:
        extent = _extent(content, eyes_m, raster, time_ns=time_ns)
        colour = tuple(round(value * 255) for value in content.info.background)
        if extent is not None:
            window = extent_window(extent, colour, eyes_m, stack, before)
    if window is not None:
        raster = window.box.cut(raster)
    views, every = raster_views(eyes_m, raster, reduction=reduction), block_px(predictor.stack.width_px)
    reads_textures = predictor.reads_textures_of(content.draws_in) and len(views) == 2
    pictures: list[U8 | DrawnPicture] = []
    depths: list[F32 | None] = []
    for first in range(0, len(views), 2):  # a source has one picture for each side, so people are drawn in turn
        pair = views[first : first + 2]
        content.expect(pair, time_ns=time_ns)
        drawn = [_drawn(predictor, content, view, time_ns=time_ns) for view in pair]
        if in_depth:
            nearness = _nearness(content, pair, window, every=every)
            depths += nearness if len(views) == 2 else [None if depth is None else depth.copy() for depth in nearness]
        # Reading a picture back waits until it is complete, so draw both pictures before reading either of them back.
        read = [p.pixels() if isinstance(p, DrawnPicture) and not reads_textures else p for p in drawn]
        pictures += read if len(views) == 2 else [np.array(p) for p in read]
    relief = _relief(depths, views, stack, window, every=every) if in_depth else None
    job = Job(Targets(stack, eyes_m, drawn_views(pictures, stack, window)), window=window, relief=relief)
    return trim(job, before) if trimmed else job


def _extent(content: ContentSource, eyes_m: Eyes, middle: PlaneRaster, *, time_ns: int) -> PixelRect | None:
    """Return the middle-panel box outside which both eyes see only the background, or None if unknown."""
    views = raster_views(eyes_m, middle)
    boxes = [content.extent(view, time_ns=time_ns) for view in views]
    known = [box for box in boxes if box is not None]
    return union(known) if len(known) == len(boxes) else None


def _nearness(
    content: ContentSource, pair: Sequence[View], window: SolveWindow | None, *, every: int
) -> list[F32 | None]:
    """Return the inverse distances of the content that was just drawn for a person's views, if the source knows them.
    A relief pixel has a side of `every` panel pixels.
    """
    u0, v0 = (0, 0) if window is None else (window.box.u0, window.box.v0)
    return [content.nearness(view, every=every, first=(u0 % every, v0 % every)) for view in pair]


def _relief(
    depths: Sequence[F32 | None], views: Sequence[View], stack: PanelStack, window: SolveWindow | None, *, every: int
) -> F32 | None:
    """Return the relief, on the middle panel, of the content drawn for all views, or None if a depth is unknown.
    `depths` are each view's inverse distances (`_nearness`), in the window that was drawn, if not the whole panel was.
    """
    known = [depth for depth in depths if depth is not None]
    if len(known) < len(views):
        return None
    if window is not None:
        u0, v0 = window.box.u0, window.box.v0
        whole = np.zeros((len(views), -(-stack.height_px // every), -(-stack.width_px // every)), np.float32)
        rows, columns = known[0].shape
        whole[:, v0 // every :, u0 // every :][:, :rows, :columns] = known
        known = list(whole)
    middle_m = stack.x_m[stack.count // 2]
    distance_m = [float(view.eye_m[0]) - middle_m for view in views]
    return relief_of(known, distance_m=distance_m, rim_px=RIM_PX if views[0].reduction == 1 else COARSE_RIM_PX)


def _drawn(predictor: Predictor, content: ContentSource, view: View, *, time_ns: int) -> U8 | DrawnPicture:
    """Draw a view to a texture, or an array if the content does not draw with OpenGL. Raises ContentFailure if drawing
    fails, and ContextLost if it fails in the context used by the predictor.
    """
    try:
        picture = content.draw(view, time_ns=time_ns)
    except PhasestackError:
        raise
    except Exception as error:  # moderngl raises various exceptions for a lost context
        if predictor.reads_textures_of(content.draws_in):
            raise ContextLost(f"OpenGL: {error}") from error
        raise
    if picture is None:
        return content.render(view, time_ns=time_ns)
    plain = content.info.background is None or len(set(content.info.background)) == 1
    return replace(picture, grey=content.info.grey and plain)
