"""The daemon's state, a pure function of what is there; each transition is reported once, with its reason."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from runtime.clock import NS_PER_S
from runtime.records import EyesLabel, State

Part = Literal["sensor", "content", "model", "panel"]
PARTS: tuple[Part, ...] = ("sensor", "content", "model", "panel")


@dataclass(frozen=True, slots=True)
class Conditions:
    """What one turn of the loop found."""

    eyes: EyesLabel
    missing: dict[Part, str]  # what does not work, and why in a few words; empty: all is well
    presented: bool  # True once any frame has been on the panels
    flat_wanted: bool = False  # the operator asked for the 2D picture
    stopping: str = ""  # why the daemon stops; empty: it does not
    limited: str = ""  # why the alignment to the eyes is at its limit; empty: it is not
    late: str = ""  # why fewer refreshes are shown than the display has; empty: all are
    paused: bool = False  # the operator froze the picture; it is still aligned to the eyes


def judge(conditions: Conditions) -> tuple[State, str]:
    """The state that the conditions call for, and why. Stopping, starting and what is missing come before the eyes."""
    if conditions.stopping:
        return State.STOPPING, conditions.stopping
    missing = [part for part in PARTS if part in conditions.missing]
    why = "; ".join(f"{part}: {conditions.missing[part]}" for part in missing)
    if not conditions.presented:
        return State.STARTING, f"waiting for {why}" if why else "no frame has been presented yet"
    if missing:
        return State.DEGRADED, why
    late = [conditions.late] if conditions.late else []
    if conditions.flat_wanted:
        return State.FLAT, "; ".join(["asked for", *late])
    if conditions.eyes == "none":
        return State.FLAT, "; ".join(["no viewer", *late])
    remarks = [*late, *(["the picture is paused"] if conditions.paused else [])]
    if conditions.limited:
        remarks.append(f"alignment at its limit until the next solution: {conditions.limited}")
    if conditions.eyes == "held":
        return State.HOLDING, "; ".join(["eyes lost, the last ones are held", *remarks])
    return State.TRACKING, "; ".join(["eyes seen", *remarks])


class StateMachine:
    """Holds the state, and how long each has been held."""

    def __init__(self, *, now_ns: int) -> None:
        self.state = State.STARTING
        self.missing: tuple[Part, ...] = ()
        self.reason = "started"
        self._counted_ns = now_ns
        self._held_ns = {state: 0 for state in State}

    @property
    def name(self) -> str:
        """The state as people read it: `tracking`, `degraded: sensor, panel`."""
        return f"{self.state}: {', '.join(self.missing)}" if self.state is State.DEGRADED else str(self.state)

    def update(self, conditions: Conditions, *, now_ns: int) -> bool:
        """Take in one turn; True where the state, or what is missing, is another: log it. Stopping is never left."""
        self._held_ns[self.state] += now_ns - self._counted_ns
        self._counted_ns = now_ns
        if self.state is State.STOPPING:
            return False
        before = self.name
        self.state, self.reason = judge(conditions)
        self.missing = tuple(part for part in PARTS if part in conditions.missing)
        return self.name != before

    def seconds(self, *, now_ns: int) -> dict[str, float]:
        """Seconds spent in every state up to now; the states that never were are left out."""
        held = dict(self._held_ns)
        held[self.state] += now_ns - self._counted_ns
        return {str(state): held_ns / NS_PER_S for state, held_ns in held.items() if held_ns > 0}
