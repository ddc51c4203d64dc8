"""What one solution is asked for: pictures, eyes, the part of the panels that is solved, channels, a deadline."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from runtime.model.fade import Fade
from runtime.optics.pupil import TRACKING_SIGMA_MM
from runtime.optics.rect import PixelRect
from runtime.optics.stack import PanelStack
from runtime.records import F64, U8
from runtime.support.gl import DrawnPicture

Picture = U8 | DrawnPicture


@dataclass(frozen=True, slots=True)
class Part:
    """A rectangle of every panel that is solved by itself. Beside it the outer panels stand at the middle of their
    range, from which the solver starts, and the centre panel carries what both eyes see."""

    box: PixelRect  # panel pixels; empty: nothing is solved
    kept: PixelRect  # of the centre panel, within the box: beside it that panel belongs to the rest
    fade_px: tuple[float, float]  # right and down: how far inwards what drives the outer panels fades out
    colour: tuple[int, ...] | None = None  # 8-bit codes beside the box; None: what the left eye's picture has there
    drawn: bool = False  # the job's pictures are of the box alone, not of the whole centre panel

    def stack(self, whole: PanelStack) -> PanelStack:
        """The panels cut to the box and moved to its centre, as a stack of their own."""
        box, (_, y_m, z_m) = self.box, self.shift_m(whole)
        return PanelStack(
            whole.width_m / whole.width_px * box.width_px,
            whole.height_m / whole.height_px * box.height_px,
            whole.x_m,
            box.width_px,
            box.height_px,
            None if whole.tilt is None else whole.tilt.moved(float(y_m), float(z_m)),
        )

    def shift_m(self, whole: PanelStack) -> F64:
        """(3,) where the box's centre is on the centre panel, metres; frame `stack` but for x, which is 0."""
        y_px = (self.box.u0 + self.box.u1) / 2 - whole.width_px / 2
        z_px = whole.height_px / 2 - (self.box.v0 + self.box.v1) / 2
        return np.array([0.0, y_px * whole.width_m / whole.width_px, z_px * whole.height_m / whole.height_px])

    def fade(self, whole: PanelStack) -> Fade:
        """How the part ends: gently, but where the panels themselves do."""
        box, kept = self.box, self.kept
        return Fade(
            PixelRect(kept.u0 - box.u0, kept.v0 - box.v0, kept.u1 - box.u0, kept.v1 - box.v0),
            over_px=self.fade_px,
            left=box.u0 > 0,
            top=box.v0 > 0,
            right=box.u1 < whole.width_px,
            bottom=box.v1 < whole.height_px,
        )


@dataclass(frozen=True, slots=True)
class Job:
    """One solution's task. Everything that a cheaper solution differs in is a field of it (`runtime.model.trim`)."""

    pictures: Sequence[Sequence[Picture]]  # [eye][raster] (h, w, 4) RGBA, left eye first, on `Predictor.rasters`
    eyes_m: F64  # (2, 3) left and right, frame `stack`
    # Standard deviation, an axis, of where light enters the eyes, common to both, right and up; 0: two points.
    eye_sigma_mm: float = TRACKING_SIGMA_MM
    part: Part | None = None  # None: all of the panels
    channels: int = 3  # 1: the pictures are grey, and one channel is solved for all three
    deadline_ns: int | None = None  # of `time.perf_counter_ns`: no further step begins after it; None: none

    @property
    def arrays(self) -> list[list[U8]]:
        """The pictures, read back where they were left in textures."""
        return [
            [picture.pixels() if isinstance(picture, DrawnPicture) else picture for picture in images]
            for images in self.pictures
        ]

    def solved_share(self, stack: PanelStack) -> float:
        """Of the panels' pixels, those that are solved."""
        if self.part is None:
            return 1.0
        return self.part.box.width_px * self.part.box.height_px / (stack.width_px * stack.height_px)
