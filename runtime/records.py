"""Frozen records that travel between stages. Arrays in them are never written to after construction."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Literal

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
U16 = NDArray[np.uint16]

EyesLabel = Literal["exact", "interpolated", "predicted", "held", "rested", "none"]
Inference = Literal["ran", "reused", "skipped"]


class State(StrEnum):
    """What the daemon is doing; DEGRADED names what is missing beside it."""

    STARTING = "starting"
    TRACKING = "tracking"
    HOLDING = "holding"
    FLAT = "flat"
    DEGRADED = "degraded"
    STOPPING = "stopping"


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """A pinhole camera's intrinsic matrix, pixel centres at half-integers."""

    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float


@dataclass(frozen=True, slots=True)
class EyePoints:
    """Two eyes at one instant, as a sensor or a finder measured them."""

    eyes_m: F64  # (2, 3) left, right (the viewer's own); metres; frame `sensor` or `stack`, as its carrier says
    confidence: F64  # (2,) in [0, 1], left, right
    completed: Literal["", "left", "right"] = ""  # the eye that was hidden and filled in from the head's pose


@dataclass(frozen=True, slots=True)
class SensorFrame:
    """What a driver delivers: one instant, with whichever streams the sensor has."""

    sequence: int  # counts up by one for each frame of the device; gaps are losses
    capture_ns: int  # monotonic clock, when the light was integrated
    eyes: EyePoints | None = None  # frame `sensor`; None: no face in this frame, or not this sensor's business
    colour: U8 | None = None  # (h, w, 3) RGB
    depth_mm: U16 | None = None  # (h, w), registered to the colour image where both exist; 0: no measurement
    intrinsics: Intrinsics | None = None  # of the image in which depth and colour are registered
    true_eyes_m: F64 | None = None  # (2, 3) frame `stack`; only recordings that know the truth


@dataclass(frozen=True, slots=True)
class EyesEstimate:
    """Where the eyes are (or will be) at one instant, and how that is known."""

    time_ns: int  # the instant asked for
    capture_ns: int  # of the newest sample that went into it; 0 with label none
    eyes_m: F64 | None  # (2, 3) left, right; frame `stack`; None with label none
    label: EyesLabel
    age_ns: int = 0  # time_ns - capture_ns


@dataclass(frozen=True, slots=True)
class PanelFrame:
    """What all panels show together at one refresh: a solution aligned to the eyes, the flat picture, or both mixed."""

    number: int  # of the refresh: all panels show the same
    solved: U8 | None  # (N, height_px, width_px, 4) RGBA, rear to front; layers solved for two eyes; None: none yet
    solved_version: int  # another number whenever `solved` holds other values
    solved_from_shown: tuple[F64, ...] = ()  # per panel (3, 3): pixels of `solved` from shown ones; (): as they are
    flat: U8 | None = None  # the same shape: the picture for eyes anywhere; never aligned
    flat_version: int = 0
    flatness: float = 0.0  # 0: `solved` alone, 1: `flat` alone, between: mixed linearly, code by code


@dataclass(frozen=True, slots=True)
class PresentReport:
    """What presenting a PanelFrame came to."""

    number: int
    present_ns: int  # when the last panel's light left, as well as it is known
    skew_ms: float  # between the first and the last panel
    vblank_ns: int | None = None  # the vertical blank that it was shown at, as well as it is known; None: no such thing


@dataclass(frozen=True, slots=True)
class PlanItem:
    """One thing that is left out, why, what it saves and what it costs."""

    what: str
    why: str
    saves_ms: float | None  # None: not measured
    costs_db: float | None


@dataclass(frozen=True, slots=True)
class FrameAccount:
    """One turn of the loop, as frames.jsonl tells it."""

    frame: int
    capture_ns: int
    predicted_for_ns: int
    present_ns: int
    eyes_m: F64 | None  # (2, 3), frame `stack`
    eyes_label: EyesLabel
    state: State
    inference: Inference
    presented: bool
    skew_ms: float
    stage_ms: dict[str, float] = field(default_factory=dict)  # on the run's clock
    measured_ms: dict[str, float] = field(default_factory=dict)  # on the machine's clock, whatever the run's is
