"""uvicorn's connections, of which those that wait for a request hold up nobody."""

from __future__ import annotations

import asyncio
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol

CONNECTIONS_MAX = 64
REQUEST_S = 5.0  # for a whole request to come


class LimitedConnection(H11Protocol):
    """One that asks nothing is let go; where all places are taken, the one that has waited longest goes."""

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self.made_s = self.loop.time()
        self._timer: asyncio.TimerHandle = self.loop.call_later(REQUEST_S, self._let_go)
        if len(self.connections) > CONNECTIONS_MAX:
            waiting = [one for one in self.connections if isinstance(one, LimitedConnection) and one.waits]
            min(waiting, key=lambda one: one.made_s).transport.abort()  # this one, where all others are answered

    def connection_lost(self, exc: Exception | None) -> None:
        self._timer.cancel()
        super().connection_lost(exc)

    @property
    def waits(self) -> bool:
        """For a request."""
        cycle: Any = self.cycle  # None before the first request
        return cycle is None or bool(cycle.response_complete)

    def _let_go(self) -> None:
        if self.waits and self in self.connections:  # it is another protocol's after an upgrade
            self.transport.abort()
