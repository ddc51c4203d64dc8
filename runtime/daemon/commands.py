"""Commands sent to the running daemon by operators. Each is checked before the loop starts it."""

from __future__ import annotations

from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

from runtime.config import PLACING
from runtime.support.untrusted_input import shown

Name = Literal["scene", "next", "place", "model", "pause", "resume", "flat", "reload", "blackbox"]
NAMES: tuple[Name, ...] = get_args(Name)


@dataclass(frozen=True, slots=True)
class Command:
    """A command, started by the loop between two refreshes and answered exactly once. Do not carry out a
    command unless `take` has returned True, because the client may have given up.
    """

    name: Name
    value: Any = None  # for scene and model, a name; for place, settings, or {} to use the configured placement
    answer: Future[dict[str, Any]] = field(default_factory=Future)

    def take(self) -> bool:
        """Claim the command in order to carry it out. Returns False if the client has given up."""
        return self.answer.set_running_or_notify_cancel()

    def done(self, **state: Any) -> None:
        """Report to the client that the command succeeded, with the new state."""
        self.answer.set_result({"ok": True, **state})

    def refuse(self, why: str) -> None:
        """Report to the client that the command was refused, without any change."""
        self.answer.set_result({"ok": False, "error": why or "refused"})


def parse(request: Any) -> Command:
    """Return the command in a request. Raises ValueError, with one line, if it is invalid."""
    if not isinstance(request, dict):
        raise ValueError("a request must be one JSON object")
    name, value = request.get("command"), request.get("value")
    if name not in NAMES:
        raise ValueError(f"command: unknown command; use one of status, {', '.join(NAMES)}")
    if name in ("scene", "model") and not (isinstance(value, str) and value):
        raise ValueError(f"value: {name} requires a name")
    if name == "place":
        value = value if value is not None else {}
        if not isinstance(value, dict):
            raise ValueError(
                "value: place requires an object containing settings, or null to restore the configured placement"
            )
        for key in value:
            if key not in PLACING:
                raise ValueError(f"value.{shown(key)}: place accepts only {', '.join(PLACING)}")
    return Command(name, value if name in ("scene", "model", "place") else None)
