"""Draw separate pictures for points of the pupils, so that eyes can focus at a depth.

`content.focus` decides which content gets them: `auto` takes content that is known to lie between the panels, `on`
takes any that can be drawn from any place. Stereo pairs, films and programs have two views and never qualify.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from runtime.content.base import ContentInfo, ContentSource
from runtime.errors import ContentFailure
from runtime.model.job import Job, drawn_views
from runtime.optics.focus import SOLVED_POINTS_M, points_of_pupils
from runtime.optics.relief import block_px
from runtime.optics.stack import PlaneRaster
from runtime.plan.drawing import raster_views

Focus = Literal["off", "auto", "on"]

EYES_MOST = 2  # with more, steps for points of all pupils would have more ray sets than the kernels sum exactly
BETWEEN_M = 0.005  # how far in front of the front panel or behind the rear one content still counts as between them


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
    """Return True if all content that was drawn for a job is known to lie between the outer panels."""
    rear_m, front_m = min(job.stack.x_m) - BETWEEN_M, max(job.stack.x_m) + BETWEEN_M
    for view in raster_views(job.eyes_m, raster):
        nearness = content.nearness(view, every=block_px(job.stack.width_px), first=(0, 0))
        if nearness is None:
            return False
        x_m = float(view.eye_m[0]) - 1 / nearness[nearness > 0]
        if x_m.size and not (rear_m <= x_m.min() and x_m.max() <= front_m):
            return False
    return True
