"""Messages between the presenter and a solver. There are no others.

The presenter sends `SolveRequest`, of which the newest replaces the others, and an `Order` for anything else. Each
order is carried out between two solutions and gets one last `Answer`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from runtime.config import Settings
from runtime.content.base import ContentInfo
from runtime.evaluation.refresh_quality import RefreshTargets
from runtime.frame.effort import Costs
from runtime.model.base import ModelFacts
from runtime.plan.savings import Measured
from runtime.records import F64, Effort, Solution

Wanted = Mapping[str, tuple[F64, int]]  # eyes (2, 3) in frame `stack` and a time, keyed by field of `RefreshTargets`


@dataclass(frozen=True, slots=True)
class ChangeSettings:
    """Order to load what other settings request, and then use it. Answered by `Progress`, then `Done`."""

    settings: Settings
    reload_content: bool = False  # load the content even if its settings are the same
    number: int = 0  # set by the host, as for all orders


@dataclass(frozen=True, slots=True)
class Cancel:
    """Order to give up a `ChangeSettings` that is still loading. Not answered; the change is."""

    change: int  # number of the change
    number: int = 0


@dataclass(frozen=True, slots=True)
class Move:
    """Order to place the scene. Answered by `Done`."""

    placing: Mapping[str, Any]  # values of settings in [content]
    number: int = 0


@dataclass(frozen=True, slots=True)
class Skip:
    """Order to advance the playlist to its next entry. Answered by `Done`."""

    time_ns: int
    number: int = 0


@dataclass(frozen=True, slots=True)
class Draw:
    """Order to draw target pictures. Answered by `Drawn`."""

    wanted: Wanted
    scene: int | None  # the `Facts.scene` to draw; None: the current one
    fov_deg: float  # the pictures' horizontal field of view
    number: int = 0


Order = ChangeSettings | Cancel | Move | Skip | Draw


@dataclass(frozen=True, slots=True)
class Facts:
    """Scene, model and device in use. Only an order changes them, except for `info`."""

    version: int  # changes with anything else below
    scene: int  # changes whenever the content is replaced or moved
    settings: Settings
    info: ContentInfo  # a playlist changes it
    model: ModelFacts
    backend: str
    backend_why: str


@dataclass(frozen=True, slots=True)
class Live:
    """Values that change by themselves while the solver works."""

    problem: str = ""  # the content's fault
    program: Mapping[str, Any] | None = None  # status of the program that draws the scene
    playlist: Mapping[str, Any] | None = None  # a playlist's entries and position
    seeing: tuple[bool, ...] = (True, True)  # eyes that can see the display
    measured: Measured = field(default_factory=Measured)  # measured worth of the plan's savings


@dataclass(frozen=True, slots=True)
class Progress:
    """Answer to a `ChangeSettings` that is still loading."""

    number: int
    text: str


@dataclass(frozen=True, slots=True)
class Done:
    """Answer to a `ChangeSettings`, `Move` or `Skip`."""

    number: int
    problem: str = ""  # reason for a refusal; empty: carried out
    facts: Facts | None = None  # None without a change


@dataclass(frozen=True, slots=True)
class Drawn:
    """Answer to a `Draw`."""

    number: int
    targets: RefreshTargets | None  # None: the scene has been replaced, or could not be drawn


Answer = Progress | Done | Drawn


@dataclass(frozen=True, slots=True)
class SolverUpdate:
    """The results of one request or, in `SolverHost.news`, the latest results of all requests."""

    solution: Solution | None = None  # a new solution for two eyes
    flat: Solution | None = None  # a new flat picture
    missing: dict[str, str] = field(default_factory=dict)  # reason for each failed part (content, model)


# Only between a solver's process and its host:


@dataclass(frozen=True, slots=True)
class Slot:
    """Place of a solution's layers in the shared memory."""

    index: int
    shape: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Busy:
    """The solver has begun to work."""

    since_ns: int
    effort: Effort | None  # of the solution; None: an order


@dataclass(frozen=True, slots=True)
class Stepped:
    """The solver has carried out a request. The solutions' layers are in shared memory."""

    update: SolverUpdate
    solution: Slot | None
    flat: Slot | None
    took_ns: int
    costs: Costs
    live: Live
    info: ContentInfo


@dataclass(frozen=True, slots=True)
class Idle:
    """The solver is ready for a request."""

    costs: Costs
    live: Live
    facts: Facts
    first: Mapping[int, Mapping[str, float]]  # first costs of the model, for a later solver
