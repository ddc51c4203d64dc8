"""Process that serves drawing programs, and outlives the solver (`content.program_link`)."""

from __future__ import annotations

import secrets
import select
import threading
from importlib import import_module
from typing import Any

from runtime.support.background import begin, patience_s
from runtime.support.channel import Channel
from runtime.support.process import Parent, Role, Worker
from runtime.support.untrusted_input import MIB

NICENESS = 5  # as the solver, which waits for it
MEMORY_BYTES = 2048 * MIB  # for unread messages of programs that do not share memory
ALLOWED_S, LOOK_S = 5.0, 0.25
ENDS_S = 0.5  # how long the starter gets to end


class Programs:
    """Keeps the process, which is started when a solver first asks for it.

    Both ends of the channel between the two stay open, so that each of them can be replaced.
    """

    def __init__(self) -> None:
        """Begin to wait. Raises OSError without a descriptor left, and TransientError without a thread."""
        self._solver_end, self._server_end = Channel.pair()
        self._token = secrets.token_urlsafe(24)
        self._worker: Worker | None = None
        self._closing = threading.Event()
        self._starter = begin("programs' starter", self._start)

    @property
    def descriptor(self) -> int:
        """File descriptor of the channel, which each solver inherits."""
        return self._solver_end.fileno()

    def status(self) -> list[dict[str, Any]]:
        return [] if self._worker is None else [self._worker.status()]

    def close(self) -> None:
        """End the process, if there is one."""
        self._closing.set()
        self._solver_end.close()  # ends the starter's wait, once the solver has ended
        self._starter.join(patience_s(ENDS_S))
        if self._worker is not None:
            self._worker.close()
        self._server_end.close()

    def _start(self) -> None:
        asked, end = select.poll(), self._server_end.fileno()
        asked.register(end, select.POLLIN)
        asked.poll()
        if not self._closing.is_set():
            role = Role("program server", main, niceness=NICENESS, memory_bytes=MEMORY_BYTES)
            self._worker = Worker(role, lambda: (end, self._token), files=(end,))


def main(parent: Parent, descriptor: int, token: str) -> None:
    """Serve programs until the parent closes the channel."""
    # Imported only here, because the libraries of a server would delay the presenter's refreshes.
    serving: Any = import_module("runtime.content.program_serving").Serving(Channel.of(descriptor), token)
    parent.ready()
    while True:
        parent.allow(ALLOWED_S)
        serving.take(LOOK_S)
        parent.receive()
