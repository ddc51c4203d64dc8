"""Drawing what a model wants to see: the one place where content, views and models meet."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from runtime.content.base import ContentSource, View
from runtime.errors import ContextLost, PhasestackError
from runtime.model.job import Job, Part, Picture
from runtime.model.predictor import Predictor
from runtime.model.trim import Scene, trim
from runtime.optics.pupil import TRACKING_SIGMA_MM
from runtime.optics.rect import PixelRect, union
from runtime.optics.stack import PanelStack, PlaneRaster
from runtime.optics.views import image_from_stack, raster_from_stack
from runtime.records import F64, U8
from runtime.support.gl import DrawnPicture


def raster_views(eyes_m: F64, raster: PlaneRaster) -> tuple[View, View]:
    """Left and right eye's views of one raster; eyes (2, 3), frame `stack`."""
    left, right = (
        View(eye, side, raster_from_stack(eye, raster), raster.width_px, raster.height_px)
        for side, eye in enumerate(eyes_m)
    )
    return left, right


def retina_view(eye_m: F64, side: int, *, width_px: int, height_px: int, fov_deg: float) -> View:
    """The view of an eye's own image, looking at the stack's origin."""
    projection = image_from_stack(eye_m, width_px=width_px, height_px=height_px, fov_deg=fov_deg)
    return View(eye_m, side, projection, width_px, height_px)


def retina_pictures(
    content: ContentSource, eyes_m: F64, stack: PanelStack, *, fov_deg: float, time_ns: int
) -> tuple[U8, U8]:
    """What content shows to eyes (2, 3), frame `stack`: (h, w, 3) retina pictures, panel size."""
    size = {"width_px": stack.width_px, "height_px": stack.height_px}
    views = [retina_view(eye, side, **size, fov_deg=fov_deg) for side, eye in enumerate(eyes_m)]
    content.expect(views, time_ns=time_ns)
    left, right = (np.ascontiguousarray(content.render(view, time_ns=time_ns)[..., :3]) for view in views)
    return left, right


def drawn_for(
    predictor: Predictor,
    content: ContentSource,
    eyes_m: F64,
    *,
    time_ns: int,
    trimmed: bool = False,
    before: Part | None = None,
    eye_sigma_mm: float = TRACKING_SIGMA_MM,
    deadline_ns: int | None = None,
) -> Job:
    """What a model is asked for eyes (2, 3), with the pictures that it wants.

    They stay in textures where the model reads those. Arrays are copied only where a source's own would be drawn over
    by the next raster: else they are the source's. trimmed: what the scene does not need is left out (`trim`), also of
    the drawing where the content knows where it lies; before: of the job before.
    """
    stack, trimmed = predictor.stack, trimmed and predictor.trims
    job, scene = Job((), eyes_m, eye_sigma_mm, deadline_ns=deadline_ns), Scene(stack, before=before)
    if trimmed and content.info.background is not None:
        colour = tuple(round(value * 255) for value in content.info.background)
        extent = _extent(content, eyes_m, stack, time_ns=time_ns)
        job, _ = trim(job, replace(scene, extent=extent, colour=colour))
    rasters = predictor.rasters(eyes_m)
    if job.part is not None:
        rasters = tuple(job.part.box.cut(raster) for raster in rasters)
    images: list[list[Picture]] = [[], []]
    for raster in rasters:
        views = raster_views(eyes_m, raster)
        content.expect(views, time_ns=time_ns)
        for view in views:
            if len(rasters) == 1 and (drawn := _drawn(predictor, content, view, time_ns=time_ns)) is not None:
                images[view.side].append(drawn)
                continue
            picture = content.render(view, time_ns=time_ns)
            images[view.side].append(picture.copy() if len(rasters) > 1 else picture)
    job = replace(job, pictures=images)
    return trim(job, scene)[0] if trimmed else job


def _extent(content: ContentSource, eyes_m: F64, stack: PanelStack, *, time_ns: int) -> PixelRect | None:
    """The centre panel's pixels beside which both eyes see the background alone; None: the content doesn't know."""
    views = raster_views(eyes_m, stack.panel(stack.count // 2))
    boxes = [content.extent(view, time_ns=time_ns) for view in views]
    known = [box for box in boxes if box is not None]
    return union(known) if len(known) == len(boxes) else None


def _drawn(predictor: Predictor, content: ContentSource, view: View, *, time_ns: int) -> DrawnPicture | None:
    """A picture that is left in a texture which the model reads; None: there is none, or it reads arrays.

    Raises ContentFailure, ContextLost.
    """
    if content.draws_in is None or not predictor.reads_textures_of(content.draws_in):
        return None
    try:
        picture = content.draw(view, time_ns=time_ns)
    except PhasestackError:
        raise
    except Exception as error:  # a lost context answers with whatever moderngl has at hand
        raise ContextLost(f"OpenGL: {error}") from error
    plain = content.info.background is None or len(set(content.info.background)) == 1
    return picture and replace(picture, grey=content.info.grey and plain)
