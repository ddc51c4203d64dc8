"""The input of one solution: pictures, eyes, window of the panels, channels, deadline."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from runtime.optics.pupil import TRACKING_SIGMA_MM
from runtime.optics.rect import PixelRect
from runtime.optics.stack import PanelStack
from runtime.records import F64, U8
from runtime.support.gl import DrawnPicture

Picture = U8 | DrawnPicture


@dataclass(frozen=True, slots=True)
class Part:
    """The window of every panel that is solved.

    Outside it the outer panels stay at mid-range, where the solver starts; the middle panel carries the common picture.
    """

    box: PixelRect  # panel pixels; empty: nothing is solved
    kept: PixelRect  # of the middle panel, within the box: beside it that panel belongs to the rest
    taper_px: tuple[float, float]  # right and down: how far inwards what drives the outer panels fades out
    colour: tuple[int, ...] | None = None  # 8-bit codes beside the box; None: what the pictures have there
    drawn: bool = False  # the job's pictures are of the box alone, not of the whole middle panel


@dataclass(frozen=True, slots=True)
class Own:
    """Still pictures, along whose own pixels' rays panels are solved."""

    pictures: Sequence[U8]  # (h, w, 3) of the left and the right eye
    projections: F64  # (2, 3, 4) their pixels from frame `stack`


@dataclass(frozen=True, slots=True)
class Job:
    """The task of one solution; what a cheaper solution changes is a field (`runtime.model.trim`)."""

    pictures: Sequence[Sequence[Picture]]  # [eye][raster] (h, w, 4) RGBA, left eye first, on `Predictor.rasters`
    eyes_m: F64  # (2, 3) left and right, frame `stack`
    # Standard deviation of the tracker's error, an axis, common to both eyes, right and up; 0: they are known.
    eye_sigma_mm: float = TRACKING_SIGMA_MM
    own: Own | None = None  # None: the rays of `pictures`
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
