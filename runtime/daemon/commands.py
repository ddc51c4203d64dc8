"""What can be told to the running daemon, checked before it reaches the loop."""

from __future__ import annotations

import math
import queue
import threading
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

from runtime.support.foreign import shown
from runtime.support.ranges import BUDGET_MOST_MS

Name = Literal[
    "scene", "playlist", "next", "place", "model", "pause", "resume", "flat", "budget", "reload", "blackbox", "restart"
]  # fmt: skip
NAMES: tuple[Name, ...] = get_args(Name)
SHOWS_MAX = 64
PLACING = ("scale", "offset_m", "rotation_deg", "turntable_per_min")  # of `place`: settings of [content]


@dataclass(frozen=True, slots=True)
class Command:
    """One command of an operator. The loop carries it out between two turns, or begins to, and answers exactly once.

    Whoever carries it out takes it first, and leaves it where `take` says so: what was given up is never done.
    `flat` with value True holds the 2D picture until `resume`; `pause` freezes the picture until `resume`.
    """

    name: Name
    value: Any = None  # scene, model: str; place: settings, none for the configured ones; budget: milliseconds or 0
    told: dict[str, Any] = field(default_factory=dict)  # beside `ok`, once it is done: what came of it
    _answers: queue.SimpleQueue[str] = field(default_factory=queue.SimpleQueue)
    _decided: threading.Lock = field(default_factory=threading.Lock)  # who has it says whether it is carried out

    def take(self) -> bool:
        """It is carried out from now on. False: who asked has given it up; it must not be done."""
        return self._decided.acquire(blocking=False)

    def give_up(self) -> bool:
        """It is not wanted any more. False: too late, it has been taken."""
        return self._decided.acquire(blocking=False)

    @property
    def taken(self) -> bool:
        """It is being carried out, or was given up."""
        return self._decided.locked()

    def done(self) -> None:
        """It was carried out."""
        self._answers.put("")

    def refuse(self, why: str) -> None:
        """It could not be carried out; nothing has changed."""
        self._answers.put(why or "refused")

    def wait(self, timeout_s: float) -> str | None:
        """Empty: done. Text: why not. None: the loop did not answer in time."""
        try:
            return self._answers.get(timeout=timeout_s) if timeout_s > 0 else self._answers.get_nowait()
        except queue.Empty:
            return None


def parse(request: Any) -> Command:
    """A request as it came through the socket. Raises ValueError with one line that says what is wrong."""
    if not isinstance(request, dict):
        raise ValueError("a request is one JSON object")
    name, value = request.get("command"), request.get("value")
    if name not in NAMES:
        raise ValueError(f"command: unknown; one of status, {', '.join(NAMES)}")
    if name in ("scene", "model") and not (isinstance(value, str) and value):
        raise ValueError(f"value: {name} wants a name")
    if name == "place":
        return Command(name, _placing(value))
    if name == "playlist":
        return Command(name, _shows(value))
    if name == "budget":
        budget_ms = _number(value, "value: budget wants milliseconds")
        if not 0 <= budget_ms <= BUDGET_MOST_MS:
            raise ValueError(f"value: budget must lie in 0 to {BUDGET_MOST_MS:.0f} ms")
        return Command(name, budget_ms)
    return Command(name, value if name in ("scene", "model") else None)


def _number(value: Any, wanted: str) -> float:
    """A finite number. Raises ValueError with `wanted`."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(wanted)
    try:
        number = float(value)
    except OverflowError:  # JSON's whole numbers have no end
        number = math.inf
    if not math.isfinite(number):
        raise ValueError(wanted)
    return number


def _shows(value: Any) -> list[dict[str, Any]]:
    """What `playlist` is to show; how long it may be, and names, are checked where the list is read."""
    if not isinstance(value, list) or not 0 < len(value) <= SHOWS_MAX:
        raise ValueError(f"value: playlist wants a list of 1 to {SHOWS_MAX} scenes with their seconds")
    shows = []
    for number, show in enumerate(value):
        if not (isinstance(show, dict) and set(show) == {"scene", "seconds"} and isinstance(show["scene"], str)):
            raise ValueError(f"value[{number}]: playlist wants a scene and its seconds, and nothing else")
        shows.append(show | {"seconds": _number(show["seconds"], f"value[{number}].seconds: playlist wants a number")})
    return shows


def _placing(value: Any) -> dict[str, Any]:
    """What `place` changes; its values are checked with the settings."""
    if not isinstance(value, dict | None):
        raise ValueError("value: place wants an object of settings, or null for the configured ones")
    for key in value or {}:
        if key not in PLACING:
            raise ValueError(f"value.{shown(key)}: place knows {', '.join(PLACING)}")
    return value or {}
