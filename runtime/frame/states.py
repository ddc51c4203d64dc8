"""Determine the daemon's state from observed conditions, and detect late refreshes."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Literal

from runtime.clock import NS_PER_S
from runtime.errors import without_secrets
from runtime.records import EyesLabel, State

Part = Literal["sensor", "content", "model", "panel"]
PARTS: tuple[Part, ...] = ("sensor", "content", "model", "panel")


@dataclass(frozen=True, slots=True)
class Conditions:
    """Conditions observed at one refresh."""

    eyes: EyesLabel
    missing: dict[Part, str]  # failed parts, with a short reason
    presented: bool  # True once any frame has been on the panels
    flat_wanted: bool = False  # the operator asked for the 2D picture
    stopping: str = ""  # reason for stopping; empty: not stopping
    limited: str = ""  # why the alignment to the eyes is at its limit; empty if it is not
    late: str = ""  # message if there are fewer refreshes than the display's rate requires; otherwise empty
    paused: bool = False  # the operator froze the picture; it is still aligned to the eyes


def judge(conditions: Conditions) -> tuple[State, str]:
    """Return the state and its reason. Priority: stopping, starting, missing parts, then the eyes."""
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
        return State.FLAT, "; ".join(["requested", *late])
    if conditions.eyes == "none":
        return State.FLAT, "; ".join(["no viewer", *late])
    remarks = [*late, *(["the picture is paused"] if conditions.paused else [])]
    if conditions.limited:
        remarks.append(f"the alignment has reached its limit until the next solution: {conditions.limited}")
    if conditions.eyes == "held":
        return State.HOLDING, "; ".join(["eyes lost; keeping the last position", *remarks])
    return State.TRACKING, "; ".join(["eyes seen", *remarks])


class StateMachine:
    """Current state of the daemon, and the time spent in each state."""

    def __init__(self, *, now_ns: int) -> None:
        self.state = State.STARTING
        self.missing: tuple[Part, ...] = ()
        self.reason = "started"
        self._counted_ns = now_ns
        self._held_ns = {state: 0 for state in State}

    @property
    def name(self) -> str:
        """Name of the state for people, such as `tracking` or `degraded: sensor, panel`."""
        return f"{self.state}: {', '.join(self.missing)}" if self.state is State.DEGRADED else str(self.state)

    def update(self, conditions: Conditions, *, now_ns: int) -> bool:
        """Update the state. Return True if it or its missing parts have changed. Stopping is final."""
        self._held_ns[self.state] += now_ns - self._counted_ns
        self._counted_ns = now_ns
        if self.state is State.STOPPING:
            return False
        before = self.name
        self.state, reason = judge(conditions)
        self.reason = without_secrets(reason)  # it may contain a camera's address, and many programs can read it
        self.missing = tuple(part for part in PARTS if part in conditions.missing)
        return self.name != before

    def seconds(self, *, now_ns: int) -> dict[str, float]:
        """Return the seconds spent so far in each state that has been entered."""
        durations_ns = dict(self._held_ns)
        durations_ns[self.state] += now_ns - self._counted_ns
        return {str(state): held_ns / NS_PER_S for state, held_ns in durations_ns.items() if held_ns > 0}


WINDOW_NS = NS_PER_S
LATE_SHARE = 0.9  # the display is late below this share of a second's refreshes
WELL_SHARE = 0.95  # it is on time again from this share on
REFRESHES_MAX = 1024  # largest number of refreshes counted in the window


class Lateness:
    """Detector of late refreshes: too few in the last second, for a full second."""

    def __init__(self, period_ns: int) -> None:
        self._wanted = WINDOW_NS / period_ns
        self._shown_ns: deque[int] = deque(maxlen=REFRESHES_MAX)
        self._begun_ns: int | None = None
        self._few_since_ns: int | None = None
        self._told = ""
        self._told_ns = 0

    def update(self, *, presented: bool, now_ns: int) -> str:
        """Count a refresh. Return "" if on time, otherwise `late: 38 of 60 refreshes per second`.

        The message is updated once a second.
        """
        if self._begun_ns is None:
            self._begun_ns = now_ns
        if presented:
            self._shown_ns.append(now_ns)
        while self._shown_ns and self._shown_ns[0] <= now_ns - WINDOW_NS:
            self._shown_ns.popleft()
        if now_ns - self._begun_ns < WINDOW_NS:
            return ""
        count = len(self._shown_ns)
        if count >= (WELL_SHARE if self._told else LATE_SHARE) * min(self._wanted, REFRESHES_MAX) - 1:
            self._few_since_ns, self._told = None, ""
        elif self._few_since_ns is None:
            self._few_since_ns = now_ns
        elif now_ns - self._few_since_ns > WINDOW_NS and (not self._told or now_ns - self._told_ns >= WINDOW_NS):
            self._told, self._told_ns = f"late: {count} of {self._wanted:.0f} refreshes per second", now_ns
        return self._told
