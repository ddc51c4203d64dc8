"""Frozen records that stages pass to each other. Their arrays never change after construction."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Literal

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
I16 = NDArray[np.int16]
U8 = NDArray[np.uint8]
U16 = NDArray[np.uint16]

EyesLabel = Literal["exact", "interpolated", "predicted", "held", "rested", "none"]
Inference = Literal["ran", "reused", "skipped"]


class State(StrEnum):
    """State of the daemon. In DEGRADED, the reason names the missing parts."""

    STARTING = "starting"
    TRACKING = "tracking"
    HOLDING = "holding"
    FLAT = "flat"
    DEGRADED = "degraded"
    STOPPING = "stopping"


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """Intrinsic parameters of a pinhole camera. Pixel centres are at half-integers."""

    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float

    @classmethod
    def centred(cls, width_px: int, height_px: int, *, fov_rad: float) -> Intrinsics:
        """Return intrinsics of a camera with square pixels and a central axis.

        fov_rad: horizontal field of view.
        """
        focal_px = width_px / 2 / math.tan(fov_rad / 2)
        return cls(width_px, height_px, focal_px, focal_px, width_px / 2, height_px / 2)


@dataclass(frozen=True, slots=True)
class EyePoints:
    """Two eyes at one instant, measured by a sensor or an eye finder."""

    eyes_m: F64  # (2, 3) left and right eye in metres, frame `sensor` or `stack` according to context
    confidence: F64  # (2,) in [0, 1], left, right
    completed: Literal["", "left", "right"] = ""  # eye that was hidden and is filled in from the head's pose
    covariance_m2: F64 | None = None  # (3, 3) covariance of the midpoint of the eyes, same frame; None: unknown


@dataclass(frozen=True, slots=True)
class SensorFrame:
    """Sample of a sensor, with all its streams at one instant."""

    sequence: int  # frame number of the device; gaps are lost frames
    capture_ns: int  # time of exposure, on the monotonic clock
    eyes: EyePoints | None = None  # frame `sensor`; None: no face, or the sensor does not find eyes
    colour: U8 | None = None  # (h, w, 3) RGB
    depth_mm: U16 | None = None  # (h, w), registered to the colour image where both exist; 0: no measurement
    intrinsics: Intrinsics | None = None  # intrinsics of the image to which depth and colour are registered
    true_eyes_m: F64 | None = None  # (2, 3) true eyes, frame `stack`; only in recordings with ground truth


@dataclass(frozen=True, slots=True)
class EyesEstimate:
    """Eyes estimated for one instant, with a label for their origin."""

    time_ns: int  # instant of the estimate
    capture_ns: int  # capture time of the newest sample used; 0 with label none
    eyes_m: F64 | None  # (2, 3) left, right; frame `stack`; None with label none
    label: EyesLabel
    sigma_m: float = 0.0  # standard deviation, per axis, of the midpoint of the eyes at that instant


@dataclass(frozen=True, slots=True)
class Parallax:
    """Motion of content on the panels when the eyes leave the position solved for (`optics.relief`).

    Content of relief b that is now seen through pixel p of the middle panel was seen, by the eyes solved for, through
    pixel p + b·(drift_px + growth·p).
    """

    drift_px: tuple[float, float]  # right and down
    growth: float  # relative growth as the head comes nearer or moves away
    middle_from_shown: tuple[F64, ...]  # per panel (3, 3), scale and shift along rays from the present midpoint
    weights: tuple[float, ...]  # for each panel, pixels per middle-panel pixel along rays from the old midpoint


@dataclass(frozen=True, slots=True)
class PanelFrame:
    """Layers of all panels at one refresh: an aligned solution, the flat picture or a mix of both."""

    number: int  # number of the refresh, the same on all panels
    solved: U8 | None  # (N, h, w, 4) RGBA layers for two eyes, rear to front, on any raster; None: no solution yet
    solved_version: int  # changes whenever `solved` changes
    solved_from_shown: tuple[F64, ...] = ()  # per panel (3, 3), in the panels' pixels; (): layers shown as solved
    flat: U8 | None = None  # (N, height_px, width_px, 4) flat picture, which is never aligned
    flat_version: int = 0
    flatness: float = 0.0  # weight of `flat` in a linear mix of codes; 0: `solved` alone, 1: `flat` alone
    size_px: tuple[int, int] | None = None  # columns and rows of the panels; None: those of `solved`
    relief: F32 | None = None  # (h, w) relief of the solution's content, on the middle panel; None: unknown
    parallax: Parallax | None = None  # None: content does not move on the middle panel


@dataclass(frozen=True, slots=True)
class PresentReport:
    """Result of presenting a PanelFrame."""

    number: int
    present_ns: int  # estimated time at which the last panel was lit
    skew_ms: float  # time between the first and the last panel's swap
    vblank_ns: int | None = None  # estimated vertical blank of the refresh; None: not applicable


@dataclass(frozen=True, slots=True)
class PlanItem:
    """Saving of the plan: the omitted work, the reason, the time saved and the quality lost."""

    what: str
    why: str
    saves_ms: float | None  # None: not measured
    costs_db: float | None


@dataclass(frozen=True, slots=True)
class FrameTiming:
    """Predicted times, on the run's clock, at which a refresh wakes, presents and is displayed."""

    id: int  # refresh number
    wake_ns: int
    present_ns: int  # time of the vertical blank or, without one, of the end of presenting
    photon_ns: int  # middle of the display time


@dataclass(frozen=True, slots=True)
class SolveRequest:
    """Request from the presenter to the solver. It replaces an older request that has not begun."""

    time_ns: int  # instant to solve for: middle of the solution's expected display time
    eyes_m: F64 | None  # (2, 3) left, right; frame `stack`; predicted for `time_ns`; None: no viewer
    eyes_label: EyesLabel
    sigma_m: float  # standard deviation of these eyes per axis
    flat_wanted: bool  # the flat picture is shown or will be needed
    paused: bool = False  # True: no new solutions
    effort: Effort | None = None  # effort for a new solution; None: full
    refined_to: Effort | None = None  # effort to continue the newest solution with, if nothing has changed


@dataclass(frozen=True, slots=True)
class Effort:
    """Work spent on a solution, as a raster and a number of updates of all panels."""

    reduction: int = 1  # divisor for the panels' rows and columns
    steps: int = 0
    continued_from: int | None = None  # steps that the continued solution had already done; None: a new one

    @property
    def name(self) -> str:
        """Short name such as `1/2+1`, for half the rows and columns and one step."""
        return f"1/{self.reduction}+{self.steps}"


@dataclass(frozen=True, slots=True)
class Measures:
    """Measurements of a solution, as squared errors of intensities in 0..1; None: not measured."""

    residual: float | None = None  # error of sampled rays against the solution's targets
    detail: Mapping[int, float] = field(default_factory=dict)  # error of the pictures on coarser rasters, by reduction
    contrast: float | None = None  # half the variance, the error between unrelated pictures
    change: tuple[float, float, float] | None = None  # from the previous pictures: error, metres moved, seconds


@dataclass(frozen=True, slots=True)
class Solution:
    """Immutable layers for one pair of eyes, or of the flat picture."""

    number: int  # counted from 1, for solutions and flat pictures together
    layers: U8  # (N, h, w, 4) RGBA, rear to front; in the panels' pixels, or fewer (`effort.reduction`)
    solved_for_m: F64 | None  # (2, 3) left, right; frame `stack`; None: a flat picture
    solved_for_ns: int  # instant for which its eyes and content were predicted
    seeing: tuple[bool, bool] = (True, True)  # left, right: False for an eye out of range, replaced by the other
    eye_sigma_m: float | None = None  # tracking error that the solution allows for
    stage_ms: dict[str, float] = field(default_factory=dict)  # time of each of `SOLVING_STAGES`, on the run's clock
    effort: Effort | None = None  # None: flat
    measures: Measures | None = None
    relief: F32 | None = None  # (h, w) relief of its content, on the middle panel (`optics.relief`); None: unknown


@dataclass(frozen=True, slots=True)
class RefreshAccount:
    """Record of one refresh, written as a line of frames.jsonl (docs/contracts.md)."""

    frame: int
    capture_ns: int  # capture time of the newest sample used; 0: none
    predicted_for_ns: int  # display time
    present_ns: int
    eyes_m: F64 | None  # (2, 3) eyes to which the panels are aligned; frame `stack`
    eyes_label: EyesLabel
    eye_sigma_mm: float | None  # standard deviation of the eyes per axis; None without eyes
    state: State
    solution: int | None  # number of the solution that is shown; None: the flat picture alone
    solved_for_m: F64 | None  # (2, 3)
    solution_age_ms: float | None  # display time minus the solution's instant
    inference: Inference  # ran: first refresh with its solution; reused: a later one; skipped: no solution
    presented: bool
    skew_ms: float
    photon_ns: int = 0  # display time, computed from the actual present time
    true_eyes_m: F64 | None = None  # (2, 3) at the display time, from recordings with ground truth
    stage_ms: dict[str, float] = field(default_factory=dict)  # on the run's clock
    effort: str | None = None  # effort of the shown solution: 1/2+1 is half the raster and one step
