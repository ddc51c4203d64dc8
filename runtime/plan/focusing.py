"""Draw separate pictures for points of the pupils, so that eyes can focus at a depth.

`content.focus` decides which content gets them: `auto` takes content known to be between the panels, `on`
takes any that can be drawn from any place. Stereo pairs, films and programs have two views and never qualify.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Literal

import numpy as np

from runtime.content.base import ContentInfo, ContentSource, View
from runtime.errors import ContentFailure
from runtime.model.job import Job, drawn_views
from runtime.optics.carried import intensities
from runtime.optics.focus import SOLVED_POINTS_M, FocusTargets, RetinaPixels, points_of_pupils
from runtime.optics.relief import block_px
from runtime.optics.retina import as_codes
from runtime.optics.stack import PanelStack, PlaneRaster
from runtime.plan.drawing import raster_views
from runtime.records import F32, F64, U8, Eyes

Focus = Literal["off", "auto", "on"]

EYES_MOST = 2  # with more, steps for points of all pupils would have more ray sets than the kernels sum exactly
BETWEEN_M = 0.005  # how far in front of the front panel or behind the rear one content still counts as between them

OUTLIERS = 0.02  # share of the content's pixels in front of its front and, again, behind its rear
NEAREST_M = 0.1  # eyes do not focus on anything nearer than this
MEASURED_PX = 640  # retina pictures have about as many of the middle panel's columns


def may_focus(info: ContentInfo, focus: Focus) -> bool:
    """Return True if content might get pictures for points of the pupils, depending on its depth."""
    return focus != "off" and not info.fixed_views


def focused_job(content: ContentSource, job: Job, *, time_ns: int, focus: Focus) -> Job | None:
    """Draw content for further points of the pupils, and return a job that includes them, or None if
    the content does not qualify. `job` was the last to be drawn from the content, for pinhole eyes on the full
    raster at the same time. Raises ContentFailure if the content cannot be drawn.
    """
    raster = _drawn_on(job)
    if not may_focus(content.info, focus) or len(job.eyes_m) != EYES_MOST or raster is None:
        return None
    if focus == "auto" and not _is_between_panels(content, job, raster):
        return None
    places_m = points_of_pupils(job.eyes_m)
    pictures = [view.pixels.copy() for view in job.views]
    for first in range(EYES_MOST, len(places_m), EYES_MOST):
        views = raster_views(places_m[first : first + EYES_MOST], raster)
        content.expect(views, time_ns=time_ns)
        pictures += [content.render(view, time_ns=time_ns).copy() for view in views]
    if len({picture.shape[:2] for picture in pictures}) > 1:
        raise ContentFailure("the pictures for points of the pupils differ in size")
    inside = job.window if raster.width_px < job.stack.width_px or raster.height_px < job.stack.height_px else None
    views_of_points = drawn_views(pictures, job.stack, inside)
    targets = replace(job.targets, eyes_m=places_m, views=views_of_points, points=len(SOLVED_POINTS_M))
    return replace(job, targets=targets)


def _drawn_on(job: Job) -> PlaneRaster | None:
    """Return the raster that a job's pictures were drawn on: the middle panel, or its part in the job's window."""
    middle = job.stack.panel(job.stack.count // 2)
    height, width = job.views[0].picture.shape[:2]
    if (height, width) == (middle.height_px, middle.width_px):
        return middle
    box = None if job.window is None else job.window.box
    return box.cut(middle) if box is not None and (height, width) == (box.height_px, box.width_px) else None


def _is_between_panels(content: ContentSource, job: Job, raster: PlaneRaster) -> bool:
    """Return True if all content that was drawn for a job is known to be between the outer panels."""
    rear_m, front_m = min(job.stack.x_m) - BETWEEN_M, max(job.stack.x_m) + BETWEEN_M
    x_m = _depths_m(content, raster_views(job.eyes_m, raster), job.stack)
    return x_m is not None and (not x_m.size or (rear_m <= float(x_m.min()) and float(x_m.max()) <= front_m))


def _depths_m(content: ContentSource, views: Sequence[View], stack: PanelStack) -> F32 | None:
    """Return the x of all content that was drawn last for views, or None if it is unknown."""
    every = block_px(stack.width_px)
    nearness = [content.nearness(view, every=every, first=(0, 0)) for view in views]
    known = [view.eye_m[0] - 1 / near[near > 0] for view, near in zip(views, nearness, strict=True) if near is not None]
    return np.concatenate(known) if len(known) == len(views) else None


def focus_targets(content: ContentSource, eyes_m: Eyes, stack: PanelStack, *, time_ns: int) -> FocusTargets | None:
    """Draw the retina pictures of a viewer's two eyes that focus on the content's front, middle and rear.

    Returns:
        The pictures, or None if the content has `fixed_views` or its depth is unknown.

    Raises:
        ContentFailure: The content could not be drawn.
    """
    raster = stack.panel(stack.count // 2)
    if content.info.fixed_views or len(eyes_m) != EYES_MOST:
        return None

    def drawn(views: Sequence[View]) -> list[U8]:
        content.expect(views, time_ns=time_ns)
        return [content.render(view, time_ns=time_ns) for view in views]

    views = raster_views(eyes_m, raster)
    drawn(views)
    x_m = _depths_m(content, views, stack)
    if x_m is None or not x_m.size:
        return None
    rear_m, front_m = (float(m) for m in np.quantile(x_m, (OUTLIERS, 1 - OUTLIERS)))
    if front_m > eyes_m[:, 0].min() - NEAREST_M:
        return None
    pixels = RetinaPixels(raster, every=max(1, raster.width_px // MEASURED_PX))
    planes_m = (front_m, (front_m + rear_m) / 2, rear_m)

    def picture(side: int, point_m: F64, matrix: F64) -> F32:
        view = View(point_m, side, matrix, raster.width_px, raster.height_px)
        return intensities(drawn([view])[0][..., :3])

    pictures = [
        as_codes(pixels.true(partial(picture, side), eye_m, plane_m=plane_m))
        for plane_m in planes_m
        for side, eye_m in enumerate(eyes_m)
    ]
    return FocusTargets(pixels, eyes_m, planes_m, tuple(pictures))
