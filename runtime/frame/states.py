"""Determine the daemon's state from the conditions at each refresh, and detect a late display."""

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
    missing: dict[Part, str]  # a short reason for each failed part
    presented: bool  # True once any frame has been on the panels
    flat_wanted: bool = False  # True if the operator asked for the flat picture
    stopping: str = ""  # why the run is stopping; empty while it continues
    limited: str = ""  # which limit the alignment to the eyes has reached; empty if none
    late: str = ""  # message if the display refreshes less often than its rate requires; otherwise empty
    paused: bool = False  # True if the operator has frozen the picture; it is still aligned to the eyes


def judge(conditions: Conditions) -> tuple[State, str]:
    """Return the daemon's state and its reason, by precedence: stopping, starting, missing parts, eyes."""
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
    """Tracks the daemon's current state and the time spent in each state."""

    def __init__(self, *, now_ns: int) -> None:
        self.state = State.STARTING
        self.missing: tuple[Part, ...] = ()
        self.reason = "started"
        self._counted_ns = now_ns
        self._held_ns = {state: 0 for state in State}

    @property
    def name(self) -> str:
        """The state's human-readable name, such as `tracking` or `degraded: sensor, panel`."""
        return f"{self.state}: {', '.join(self.missing)}" if self.state is State.DEGRADED else str(self.state)

    def update(self, conditions: Conditions, *, now_ns: int) -> bool:
        """Update the state, unless STOPPING, and return True if it or the set of failed parts has changed."""
        self._held_ns[self.state] += now_ns - self._counted_ns
        self._counted_ns = now_ns
        if self.state is State.STOPPING:
            return False
        before = self.name
        self.state, reason = judge(conditions)
        self.reason = without_secrets(reason)  # widely readable, but may contain a camera's address
        self.missing = tuple(part for part in PARTS if part in conditions.missing)
        return self.name != before

    def seconds(self, *, now_ns: int) -> dict[str, float]:
        """Return the time spent so far in each state that has been entered, in seconds, keyed by state."""
        durations_ns = dict(self._held_ns)
        durations_ns[self.state] += now_ns - self._counted_ns
        return {str(state): held_ns / NS_PER_S for state, held_ns in durations_ns.items() if held_ns > 0}


WINDOW_NS = NS_PER_S
LATE_SHARE = 0.9  # the display is late if it shows less than this share of the refreshes due in a second
WELL_SHARE = 0.95  # a late display is on time again once it shows at least this share
REFRESHES_MAX = 1024  # maximum number of refreshes counted in the window


class Lateness:
    """Detects a late display, which has shown too few refreshes per second for more than one second."""

    def __init__(self, period_ns: int) -> None:
        self._wanted = WINDOW_NS / period_ns
        self._shown_ns: deque[int] = deque(maxlen=REFRESHES_MAX)
        self._begun_ns: int | None = None
        self._few_since_ns: int | None = None
        self._told = ""
        self._told_ns = 0

    def update(self, *, presented: bool, now_ns: int) -> str:
        """Count a refresh, and return "" or, updated every second, `late: 38 of 60 refreshes per second`."""
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
