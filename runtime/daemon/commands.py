"""What can be asked of the running daemon, checked before it reaches the loop."""

from __future__ import annotations

from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

from runtime.support.foreign import shown

Name = Literal["scene", "playlist", "next", "place", "model", "pause", "resume", "flat", "reload", "blackbox"]
NAMES: tuple[Name, ...] = get_args(Name)
SHOWS_MAX = 64
SECONDS_MAX = 1e9
PLACING = ("scale", "offset_m", "rotation_deg", "turntable_per_min")  # of `place`: settings of [content]


@dataclass(frozen=True, slots=True)
class Command:
    """One command of an operator. The loop runs it between two refreshes, or begins to, and answers exactly once.

    Whoever runs it takes it first, and leaves it where `take` is False: what was given up is never done.
    `flat` holds the 2D picture until `resume`; `pause` freezes the picture until `resume`.
    """

    name: Name
    value: Any = None  # scene, model: str; place: settings, {} for the configured ones; playlist: scenes and seconds
    answer: Future[dict[str, Any]] = field(default_factory=Future)

    def take(self) -> bool:
        """It runs from now on. False: who asked has given it up; it must not be done."""
        return self.answer.set_running_or_notify_cancel()

    def done(self, **what: Any) -> None:
        """It was carried out; what: holds now."""
        self.answer.set_result({"ok": True, **what})

    def refuse(self, why: str) -> None:
        """It could not be carried out; nothing has changed."""
        self.answer.set_result({"ok": False, "error": why or "refused"})


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
    return Command(name, value if name in ("scene", "model") else None)


def _shows(value: Any) -> list[dict[str, Any]]:
    """What `playlist` is to show; how long it may be, and names, are checked where the list is read."""
    if not isinstance(value, list) or not 0 < len(value) <= SHOWS_MAX:
        raise ValueError(f"value: playlist wants a list of 1 to {SHOWS_MAX} scenes with their seconds")
    for number, show in enumerate(value):
        if not (isinstance(show, dict) and set(show) == {"scene", "seconds"} and isinstance(show["scene"], str)):
            raise ValueError(f"value[{number}]: playlist wants a scene and its seconds, and nothing else")
        seconds = show["seconds"]
        # JSON has whole numbers without end, and Infinity.
        if isinstance(seconds, bool) or not isinstance(seconds, int | float) or not 0 < seconds <= SECONDS_MAX:
            raise ValueError(f"value[{number}].seconds: playlist wants a number")
    return value


def _placing(value: Any) -> dict[str, Any]:
    """What `place` changes; its values are checked with the settings."""
    if not isinstance(value, dict | None):
        raise ValueError("value: place wants an object of settings, or null for the configured ones")
    for key in value or {}:
        if key not in PLACING:
            raise ValueError(f"value.{shown(key)}: place knows {', '.join(PLACING)}")
    return value or {}
