"""Job: the input for one solution, with target pictures, their rays and the pixels to solve."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np

from runtime.model.geometry import Geometry, TargetView, geometry_of, visible_boxes
from runtime.model.warp import reduced_view
from runtime.optics.pupil import TRACKING_SIGMA_MM
from runtime.optics.rect import PixelRect
from runtime.optics.stack import PanelStack
from runtime.records import F32, F64, U8, Eyes
from runtime.support.gl import DrawnPicture
from runtime.support.threads import parallel_map

TRACKING_SIGMA_M = TRACKING_SIGMA_MM / 1e3
NOWHERE = PixelRect(0, 0, 0, 0)
VIEWS_MOST = 8  # maximum number of views in a job


@dataclass(frozen=True, slots=True)
class SolveWindow:
    """A window to solve. Outside, the outer panels rest, and the middle one shows the common picture."""

    box: PixelRect  # pixels on every panel; may be empty
    kept: PixelRect  # pixels inside `box` to solve on the middle panel; the others show the common picture
    taper_px: tuple[float, float]  # width (right, down) of the region where the outer panels fade to the rest value
    colour: tuple[int, ...] | None = None  # 8-bit codes of the uniform background outside; None: use the pictures


@dataclass(frozen=True)
class Targets:
    """The views to show, and the rays of their pixels through the panels."""

    stack: PanelStack  # the panels, with the raster to solve, which may be coarser than the display's
    # (V, 3) eye positions, frame `stack`: the first viewer's left and right eye, then the next viewer's
    eyes_m: Eyes
    views: tuple[TargetView, ...]  # each of these eyes' target
    # Points of each pupil that have separate views; `eyes_m` and `views` list all eyes for each point in turn
    points: int = 1

    @cached_property
    def visible(self) -> Geometry:
        """Geometry for all rays that cross every panel."""
        return self._geometry(visible_boxes(self.eyes_m, self.stack))

    @cached_property
    def every_pixel(self) -> Geometry:
        """Geometry for solving every pixel on every panel, including those that the eyes do not see."""
        whole = PixelRect(0, 0, self.stack.width_px, self.stack.height_px)
        return self._geometry((whole,) * self.stack.count)

    def within(self, window: SolveWindow) -> Geometry:
        """Return the geometry for solving the pixels in a window."""
        boxes = (window.box,) * self.stack.count
        return self._geometry(boxes, kept=window.kept, taper_px=window.taper_px)

    def _geometry(self, boxes: tuple[PixelRect, ...], **how: Any) -> Geometry:
        return geometry_of(self.stack, self.eyes_m, self.views, boxes=boxes, points=self.points, **how)

    def reduced(self, reduction: int) -> tuple[TargetView, ...]:
        """Return the views averaged down by `reduction` (`reduced_view`). Cached."""
        if reduction not in self._reduced:
            middle = self.stack.panel(self.stack.count // 2)
            # Read textures back here, because only their context's thread can do so.
            views = [TargetView(view.pixels, view.plane_from_picture) for view in self.views]
            self._reduced[reduction] = tuple(parallel_map(lambda view: reduced_view(view, middle, reduction), views))
        return self._reduced[reduction]

    def on_raster(self, reduction: int) -> Targets:
        """Return the targets on panels and pictures with 1/`reduction` of the rows and columns."""

        def reduced(view: TargetView) -> TargetView:
            height, width = view.picture.shape[:2]
            size = max(1, round(width / reduction)), max(1, round(height / reduction))
            picture = np.asarray(cv2.resize(view.pixels, size, interpolation=cv2.INTER_AREA), np.uint8)
            return TargetView(picture, view.plane_from_picture @ np.diag([width / size[0], height / size[1], 1.0]))

        views = tuple(reduced(view) for view in self.views)
        return Targets(self.stack.reduced(reduction), self.eyes_m, views, self.points)

    @cached_property
    def _reduced(self) -> dict[int, tuple[TargetView, ...]]:
        return {}


@dataclass(frozen=True, slots=True)
class Savings:
    """Amount of work that still has to be done for a trimmed job."""

    solved_share: float = 1.0  # share of the panels' pixels that are solved
    channels: int = 3  # number of colour channels solved


@dataclass(frozen=True, slots=True)
class Job:
    """The input for one solution. `runtime.model.trim` changes a few fields to make it cheaper."""

    targets: Targets
    # Standard deviation, along each axis (right and up), of the tracking error, which all eyes share. 0: the eyes are
    # known exactly.
    eye_sigma_m: float = TRACKING_SIGMA_M
    window: SolveWindow | None = None  # None: solve everything the eyes see
    channels: int = 3  # 1: the pictures are grey, and one channel is solved for all three
    floats: bool = False  # also return the values before they are rounded; only without a window
    steps: int | None = None  # maximum number of updates of all panels; None: as specified by the model
    continued: bool = False  # start from the previous solution's panels if its rays were the same
    deadline_ns: int | None = None  # no step begins after this time (`time.perf_counter_ns`); None: no limit
    relief: F32 | None = None  # (h, w) relief of the content on the middle panel, for the presenter (`optics.relief`)

    @property
    def views(self) -> tuple[TargetView, ...]:
        """Each eye's view."""
        return self.targets.views

    @property
    def stack(self) -> PanelStack:
        """The panels, with the raster to solve."""
        return self.targets.stack

    @property
    def eyes_m(self) -> F64:
        """Eye positions, (V, 3) in frame `stack`."""
        return self.targets.eyes_m

    @property
    def savings(self) -> Savings:
        """Amount of work to be done for this job."""
        box = None if self.window is None else self.window.box
        pixels = self.stack.width_px * self.stack.height_px
        return Savings(1.0 if box is None else box.width_px * box.height_px / pixels, self.channels)


def drawn_views(
    pictures: Sequence[U8 | DrawnPicture], stack: PanelStack, window: SolveWindow | None = None
) -> tuple[TargetView, ...]:
    """Return the views for each eye's picture drawn on the middle panel's pixels, or a window of it."""
    raster = stack.panel(stack.count // 2)
    if window is not None:
        raster = window.box.cut(raster)
    return tuple(TargetView(picture, raster.plane_from_raster()) for picture in pictures)


def drawn_job(pictures: Sequence[U8 | DrawnPicture], eyes_m: Eyes, stack: PanelStack) -> Job:
    """Return a job, without a window, for each eye's picture drawn on the middle panel's pixels."""
    return Job(Targets(stack, eyes_m, drawn_views(pictures, stack)))


def grey_job(eyes_m: Eyes, stack: PanelStack) -> Job:
    """Return a job with uniform grey pictures, used to warm up a model."""
    grey = np.full((stack.height_px, stack.width_px, 4), 128, np.uint8)
    return drawn_job((grey, grey), eyes_m, stack)
