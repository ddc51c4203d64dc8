"""Job: the input of one solution, with targets, their rays, and the part of the panels to solve."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from runtime.model.geometry import Geometry, TargetView, geometry_of, visible_boxes
from runtime.model.warp import reduced_view
from runtime.optics.pupil import TRACKING_SIGMA_MM
from runtime.optics.rect import PixelRect
from runtime.optics.stack import PanelStack
from runtime.records import F32, F64, U8
from runtime.support.gl import DrawnPicture
from runtime.support.threads import parallel_map

TRACKING_SIGMA_M = TRACKING_SIGMA_MM / 1e3
NOWHERE = PixelRect(0, 0, 0, 0)


@dataclass(frozen=True, slots=True)
class SolveWindow:
    """Window in which every panel is solved.

    Outside the window, the outer panels stay at mid-range, where the solver starts, and the middle panel carries the
    picture that both eyes see.
    """

    box: PixelRect  # panel pixels; empty: nothing is solved
    kept: PixelRect  # middle-panel pixels inside `box` that the solution writes; the others get the flat fill
    taper_px: tuple[float, float]  # (right, down) width over which the outer panels' drive is tapered to zero
    colour: tuple[int, ...] | None = None  # 8-bit codes of the background outside; None: taken from the pictures


@dataclass(frozen=True)
class Targets:
    """Target pictures of both eyes, and their pixels' rays through the panels."""

    stack: PanelStack  # panels with the raster that is solved: the display's own or a coarser one
    eyes_m: F64  # (2, 3) left and right, frame `stack`
    views: tuple[TargetView, TargetView]  # left and right

    @cached_property
    def visible(self) -> Geometry:
        """Geometry of all rays on which the eyes see through every panel."""
        return geometry_of(self.stack, self.eyes_m, self.views, boxes=visible_boxes(self.eyes_m, self.stack))

    @cached_property
    def every_pixel(self) -> Geometry:
        """Geometry of the rays through every pixel of every panel, visible or not."""
        whole = PixelRect(0, 0, self.stack.width_px, self.stack.height_px)
        return geometry_of(self.stack, self.eyes_m, self.views, boxes=(whole,) * self.stack.count)

    def within(self, window: SolveWindow) -> Geometry:
        """Return the geometry of the rays through a window."""
        boxes = (window.box,) * self.stack.count
        return geometry_of(self.stack, self.eyes_m, self.views, boxes=boxes, kept=window.kept, taper_px=window.taper_px)

    def reduced(self, reduction: int) -> tuple[TargetView, TargetView]:
        """Return the views averaged down by `reduction` (`reduced_view`); each is computed only once."""
        if reduction not in self._reduced:
            middle = self.stack.panel(self.stack.count // 2)
            # A texture can only be read back on its context's thread, which is this one.
            views = [TargetView(view.pixels, view.plane_from_picture) for view in self.views]
            left, right = parallel_map(lambda view: reduced_view(view, middle, reduction), views)
            self._reduced[reduction] = left, right
        return self._reduced[reduction]

    @cached_property
    def _reduced(self) -> dict[int, tuple[TargetView, TargetView]]:
        return {}


@dataclass(frozen=True, slots=True)
class Savings:
    """Work that a job saves."""

    solved_share: float = 1.0  # share of the panels' pixels that is solved
    channels: int = 3


@dataclass(frozen=True, slots=True)
class Job:
    """Input of one solution. For a cheaper solution, `runtime.model.trim` changes a few fields."""

    targets: Targets
    # Standard deviation of the tracking error per axis, right and up, common to both eyes; 0: exactly known eyes.
    eye_sigma_m: float = TRACKING_SIGMA_M
    window: SolveWindow | None = None  # None: everything that the eyes see
    channels: int = 3  # 1: the pictures are grey, so one channel is solved for all three
    steps: int | None = None  # largest number of updates of all panels; None: the model's
    continued: bool = False  # start from the previous solution's panels if its rays were the same
    deadline_ns: int | None = None  # no step begins after this time (`time.perf_counter_ns`); None: no limit
    relief: F32 | None = None  # (h, w) the content's relief on the middle panel, for the presenter (`optics.relief`)

    @property
    def views(self) -> tuple[TargetView, TargetView]:
        """Views of the left and right eye."""
        return self.targets.views

    @property
    def stack(self) -> PanelStack:
        """Panels with the raster that is solved."""
        return self.targets.stack

    @property
    def eyes_m(self) -> F64:
        """Positions (2, 3) of the left and right eye, frame `stack`."""
        return self.targets.eyes_m

    @property
    def savings(self) -> Savings:
        """Work that this job saves."""
        box = None if self.window is None else self.window.box
        pixels = self.stack.width_px * self.stack.height_px
        return Savings(1.0 if box is None else box.width_px * box.height_px / pixels, self.channels)


def drawn_views(
    pictures: Sequence[U8 | DrawnPicture], stack: PanelStack, window: SolveWindow | None = None
) -> tuple[TargetView, TargetView]:
    """Return left and right views of pictures (h, w, 3 or 4) on the middle panel or its window."""
    raster = stack.panel(stack.count // 2)
    if window is not None:
        raster = window.box.cut(raster)
    left, right = (TargetView(picture, raster.plane_from_raster()) for picture in pictures)
    return left, right


def drawn_job(pictures: Sequence[U8 | DrawnPicture], eyes_m: F64, stack: PanelStack) -> Job:
    """Return the job of a whole stack for eyes (2, 3) and pictures (h, w, 3 or 4) on the middle panel."""
    return Job(Targets(stack, eyes_m, drawn_views(pictures, stack)))


def grey_job(eyes_m: F64, stack: PanelStack) -> Job:
    """Return a job with grey pictures, to warm up with."""
    grey = np.full((stack.height_px, stack.width_px, 4), 128, np.uint8)
    return drawn_job((grey, grey), eyes_m, stack)
