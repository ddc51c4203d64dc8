"""The daemon as the page asks it: however many look, its socket is asked no more often than news is wanted."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any

from runtime.daemon.client import NotRunning, ask

LOOKED_UP_AGAIN_S = {"status": 0.2, "pictures": 0.3, "log": 0.5, "about": 2.0}
LOOKED_UP_WITHIN_S = 3.0
TOLD_WITHIN_S = 70.0  # a scene or a model is loaded first


class Daemon:
    """Any thread may ask."""

    def __init__(self, sockets: tuple[Path, ...]) -> None:
        """sockets: where it may listen."""
        self._sockets = sockets
        self._locks = {name: threading.Lock() for name in LOOKED_UP_AGAIN_S}
        self._answers: dict[str, tuple[float, dict[str, Any]]] = {}

    def look_up(self, name: str) -> dict[str, Any]:
        """`status`, `pictures`, `log` or `about`; where no daemon answers, `ok` is False and `error` says why."""
        with self._locks[name]:
            asked_s, answer = self._answers.get(name, (float("-inf"), {}))
            if time.monotonic() - asked_s < LOOKED_UP_AGAIN_S[name]:
                return answer
            answer = self._asked({"command": name}, timeout_s=LOOKED_UP_WITHIN_S)
            self._answers[name] = time.monotonic(), answer
        return answer

    def tell(self, command: str, value: Any) -> dict[str, Any]:
        """One wish; what became of it."""
        return self._asked({"command": command, "value": value}, timeout_s=TOLD_WITHIN_S)

    def _asked(self, request: dict[str, Any], *, timeout_s: float) -> dict[str, Any]:
        try:
            return ask(self._sockets, request, timeout_s=timeout_s)
        except NotRunning as error:
            return {"ok": False, "running": False, "error": str(error)}
