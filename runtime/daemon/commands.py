"""Commands to the running daemon, checked before they reach the loop."""

from __future__ import annotations

from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

from runtime.support.untrusted_input import shown

Name = Literal["scene", "next", "place", "model", "pause", "resume", "flat", "reload", "blackbox"]
NAMES: tuple[Name, ...] = get_args(Name)
PLACING = ("scale", "offset_m", "rotation_deg", "turntable_per_min")  # of `place`: settings of [content]


@dataclass(frozen=True, slots=True)
class Command:
    """An operator's command. The loop begins it between two refreshes and answers it exactly once.

    It is run only after `take` returned True: a command whose client has given up is never run.
    `flat` shows the 2D picture until `resume`; `pause` freezes the picture until `resume`.
    """

    name: Name
    value: Any = None  # scene, model: str; place: settings, {} for the configured ones
    answer: Future[dict[str, Any]] = field(default_factory=Future)

    def take(self) -> bool:
        """Claim the command for execution. False: its client has given up; do not run it."""
        return self.answer.set_running_or_notify_cancel()

    def done(self, **state: Any) -> None:
        """Answer success, with the new state."""
        self.answer.set_result({"ok": True, **state})

    def refuse(self, why: str) -> None:
        """Answer a refusal, after which the state is as before."""
        self.answer.set_result({"ok": False, "error": why or "refused"})


def parse(request: Any) -> Command:
    """Return the command of a request from the socket. Raises ValueError with one line."""
    if not isinstance(request, dict):
        raise ValueError("a request is one JSON object")
    name, value = request.get("command"), request.get("value")
    if name not in NAMES:
        raise ValueError(f"command: unknown; one of status, {', '.join(NAMES)}")
    if name in ("scene", "model") and not (isinstance(value, str) and value):
        raise ValueError(f"value: {name} needs a name")
    if name == "place":
        value = value if value is not None else {}
        if not isinstance(value, dict):
            raise ValueError("value: place needs an object of settings, or null for the configured ones")
        for key in value:
            if key not in PLACING:
                raise ValueError(f"value.{shown(key)}: place takes {', '.join(PLACING)}")
    return Command(name, value if name in ("scene", "model", "place") else None)
