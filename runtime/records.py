"""Immutable records passed between the stages of the runtime.

A record's arrays never change once the record has been constructed.
"""

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
# (V, 3) eye positions in metres, frame `stack`: the left and the right eye of a viewer, then those of the next. V is 2
# unless several viewers are served.
Eyes = F64

EyesLabel = Literal["exact", "interpolated", "predicted", "held", "rested", "none"]
Inference = Literal["ran", "reused", "skipped"]
SOLVING_STAGES = ("render", "prepare", "inference", "finish", "step")  # inference: only the network; step: all updates
SHOWN_STAGES = SOLVING_STAGES[:-1]  # in frames.jsonl, where `finish` includes the steps
STAGES = ("sensor", "track", *SOLVING_STAGES, "present", "wait")


class State(StrEnum):
    """Daemon state. The reason reported with DEGRADED names the missing parts."""

    STARTING = "starting"
    TRACKING = "tracking"
    HOLDING = "holding"
    FLAT = "flat"
    DEGRADED = "degraded"
    STOPPING = "stopping"


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """Intrinsic parameters of a pinhole camera. Pixel centres have half-integer coordinates."""

    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float

    @classmethod
    def centred(cls, width_px: int, height_px: int, *, fov_rad: float) -> Intrinsics:
        """Return the intrinsics of a centred camera with square pixels and horizontal `fov_rad`."""
        focal_px = width_px / 2 / math.tan(fov_rad / 2)
        return cls(width_px, height_px, focal_px, focal_px, width_px / 2, height_px / 2)


@dataclass(frozen=True, slots=True)
class EyePoints:
    """Positions of a viewer's two eyes at one instant, measured by a sensor or an eye finder."""

    eyes_m: F64  # (2, 3) left and right eye in metres, frame `sensor` or `stack` depending on the context
    confidence: F64  # (2,) confidence in the left and right eye, 0 to 1
    completed: Literal["", "left", "right"] = ""  # hidden eye whose position was inferred from the head pose
    covariance_m2: F64 | None = None  # (3, 3) covariance of the eyes' midpoint, in the same frame; None: unknown


@dataclass(frozen=True, slots=True)
class SensorFrame:
    """A sensor sample that combines the data from all streams at one instant."""

    sequence: int  # frame number assigned by the device; a gap means lost frames
    capture_ns: int  # time of exposure, on the monotonic clock
    eyes: EyePoints | None = None  # nearest person, frame `sensor`; None: no face, or a sensor that does not find eyes
    colour: U8 | None = None  # (h, w, 3) RGB
    depth_mm: U16 | None = None  # (h, w), registered to the colour image where both exist; 0: no measurement
    intrinsics: Intrinsics | None = None  # intrinsics of the image that depth and colour are registered to
    # (2P, 3) true eyes of P people in metres, in frame `stack`, always in the same order of people; NaN: a person who
    # is absent; None: no ground truth
    true_eyes_m: F64 | None = None
    others: tuple[EyePoints, ...] = ()  # further people, nearest first, in the same frame as `eyes`

    @property
    def people(self) -> tuple[EyePoints, ...]:
        """All people's eyes, nearest first."""
        return () if self.eyes is None else (self.eyes, *self.others)


@dataclass(frozen=True, slots=True)
class EyesEstimate:
    """Estimated eye positions at one instant, with a label that says how they were obtained."""

    time_ns: int  # instant that the estimate is for
    capture_ns: int  # capture time of the newest sample used; may be 0 with label `none`
    eyes_m: F64 | None  # (2P, 3) left and right eye of each person in metres, in frame `stack`; None with label `none`
    label: EyesLabel
    sigma_m: float = 0.0  # standard deviation, along each axis, of the eyes' midpoint at `time_ns`
    people: tuple[int, ...] = ()  # number of each person in `eyes_m`


@dataclass(frozen=True, slots=True)
class Parallax:
    """Motion of the content on the panels as the eyes move away from the solution's eye positions.

    Suppose the eyes now see content with relief b through pixel p of the middle panel. Seen from the solution's eye
    positions, the same content appeared at pixel p + b·(drift_px + growth·p). The equation is derived in
    `optics.relief`.
    """

    drift_px: tuple[float, float]  # shift to the right and down
    growth: float  # relative growth as the head moves towards or away from the display
    middle_from_shown: tuple[F64, ...]  # (3, 3) for each panel: scale and shift along rays from the present midpoint
    weights: tuple[float, ...]  # for each panel: pixels per middle-panel pixel along rays from the solution's midpoint


@dataclass(frozen=True, slots=True)
class PanelFrame:
    """The layers that the panels show at one refresh: an aligned solution, the flat picture or a mix."""

    number: int  # refresh number, the same on all panels
    solved: U8 | None  # (N, h, w, 4) RGBA layers of the solution, rear to front, on any raster; None: no solution yet
    solved_version: int  # changes whenever `solved` changes
    solved_from_shown: tuple[F64, ...] = ()  # for each panel, (3, 3) map from its pixels to `solved`; empty: identity
    flat: U8 | None = None  # (N, height_px, width_px, 4) flat picture, which is never aligned
    flat_version: int = 0
    flatness: float = 0.0  # weight of `flat` in a linear mix of 8-bit codes; 0: only `solved`, 1: only `flat`
    size_px: tuple[int, int] | None = None  # panel columns and rows; None: the size of `solved`
    relief: F32 | None = None  # (h, w) relief of the solution's content on the middle panel; None: unknown
    parallax: Parallax | None = None  # None: content does not move on the middle panel
    # For each panel, `solved_from_shown` and `parallax` at the time when its own monitor shows it; empty: in step.
    on_monitors: tuple[tuple[F64, Parallax | None], ...] = ()


@dataclass(frozen=True, slots=True)
class PresentReport:
    """Times when the panels showed a PanelFrame."""

    number: int
    present_ns: int  # estimated time when the last panel was lit
    skew_ms: float  # time between the buffer swaps of the first and the last panel
    vblank_ns: int | None = None  # estimated time of the refresh's vertical blank; None: not applicable
    held_ns: int | None = None  # wait of the drawn frame until it was due; None: not drawn, or never waits


@dataclass(frozen=True, slots=True)
class PlanItem:
    """A piece of work that the plan leaves out, with the reason, the time saved and the quality lost."""

    what: str  # the omitted work
    why: str
    saves_ms: float | None  # None: not measured
    costs_db: float | None  # None: not measured


@dataclass(frozen=True, slots=True)
class FrameTiming:
    """Predicted times of one refresh, on the run's clock."""

    id: int  # refresh number
    wake_ns: int  # time when the presenter wakes
    present_ns: int  # time of the vertical blank, or else the end of presenting
    photon_ns: int  # middle of the display time


@dataclass(frozen=True, slots=True)
class SolveRequest:
    """A request from the presenter to the solver. It replaces any request that the solver has not begun."""

    time_ns: int  # instant to solve for, the middle of the solution's expected display time
    eyes_m: F64 | None  # (2P, 3) eyes of all people served, in metres, in frame `stack`, at `time_ns`; None: no viewer
    eyes_label: EyesLabel
    sigma_m: float  # standard deviation of `eyes_m` along each axis
    flat_wanted: bool  # True if the flat picture is shown or will be needed
    paused: bool = False  # True if no new solutions are wanted
    effort: Effort | None = None  # effort for a new solution; None: full effort
    refined_to: Effort | None = None  # effort to refine an unchanged solution to; None: do not refine
    people: tuple[int, ...] = (1,)  # number of each person in `eyes_m`


@dataclass(frozen=True, slots=True)
class Effort:
    """Amount of work put into a solution: the resolution of the layers and the number of steps."""

    reduction: int = 1  # divisor of the panels' rows and columns
    steps: int = 0  # updates of all panels
    continued_from: int | None = None  # number of steps in the solution being continued; None: a new solution
    focus: bool = False  # True if points of the pupils have separate pictures

    @property
    def name(self) -> str:
        """Short name of the effort, such as `1/2+1`: half the rows and columns, one step; `f`: focus."""
        return f"1/{self.reduction}+{self.steps}{'f' * self.focus}"


@dataclass(frozen=True, slots=True)
class Measures:
    """Squared errors measured for a solution, with intensities from 0 to 1. None means not measured."""

    residual: float | None = None  # error of sampled rays, measured against the solution's targets
    detail: Mapping[int, float] = field(default_factory=dict)  # error of the pictures on a coarser raster, by reduction
    contrast: float | None = None  # half the pictures' variance, used as the error of unrelated pictures
    change: tuple[float, float, float] | None = None  # error of earlier pictures, metres the eyes moved, seconds passed


@dataclass(frozen=True, slots=True)
class Solution:
    """Immutable layers computed for one pair of eye positions, or for the flat picture."""

    number: int  # counted from 1, over solutions and flat pictures together
    layers: U8  # (N, h, w, 4) RGBA layers, rear to front, on a raster that is coarser by `effort.reduction`
    solved_for_m: F64 | None  # (2P, 3) all people's eyes in metres, in frame `stack`; None: a flat picture
    solved_for_ns: int  # instant that the eyes and the content were predicted for
    seeing: tuple[bool, ...] = (True, True)  # for each eye; False: out of range, replaced by the person's other eye
    eye_sigma_m: float | None = None  # tracking error that the solution allows for
    stage_ms: dict[str, float] = field(default_factory=dict)  # time of each of `SOLVING_STAGES`, on the run's clock
    effort: Effort | None = None  # None: a flat picture
    measures: Measures | None = None
    relief: F32 | None = None  # (h, w) relief of the content on the middle panel (`optics.relief`); None: unknown
    state_version: int = 0  # the solver's state that it was computed with (`Facts.version`)
    people: tuple[int, ...] = (1,)  # number of each person in `solved_for_m`


@dataclass(frozen=True, slots=True)
class PersonAccount:
    """One person's part in a refresh. Eyes are (2, 3), left and right, in metres, in frame `stack`."""

    number: int  # counted from 1, in the order in which people came into view
    eyes_m: F64  # eyes that the panels are aligned to, as far as people have moved alike
    solved_for_m: F64 | None  # eyes that the solution was computed for; None: it was computed without this person
    true_eyes_m: F64 | None = None  # true eyes at the display time, from recordings with ground truth


@dataclass(frozen=True, slots=True)
class RefreshAccount:
    """Record of one refresh, written as a line in frames.jsonl (docs/contracts.md)."""

    frame: int
    capture_ns: int  # capture time of the newest sample used; 0: no sample
    predicted_for_ns: int  # display time
    present_ns: int
    eyes_m: F64 | None  # (2, 3) eyes that the panels are aligned to, in metres, in frame `stack`
    eyes_label: EyesLabel
    eye_sigma_mm: float | None  # standard deviation of the eyes along each axis; None: no eyes
    state: State
    solution: int | None  # number of the solution shown; None: only the flat picture
    solved_for_m: F64 | None  # (2, 3) eyes that the solution was computed for, in metres, in frame `stack`
    solution_age_ms: float | None  # display time minus the instant that the solution was computed for
    inference: Inference  # ran: first refresh to show the solution; reused: a later refresh; skipped: no solution
    presented: bool
    skew_ms: float
    photon_ns: int = 0  # display time, computed from the actual present time
    true_eyes_m: F64 | None = None  # (2, 3) true eyes at the display time, from recordings with ground truth
    stage_ms: dict[str, float] = field(default_factory=dict)  # time taken by each stage, on the run's clock
    effort: str | None = None  # name of the shown solution's effort (`Effort.name`)
    people: tuple[PersonAccount, ...] = ()  # all people served; the fields above describe the first
