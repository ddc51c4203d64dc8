"""Limited uvicorn connections, so that idle ones do not block others."""

from __future__ import annotations

import asyncio
import socket as sockets
from typing import Any

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from runtime.daemon.client import REQUEST_MAX_BYTES, REQUEST_S
from runtime.errors import InputError

LOOPBACK = "127.0.0.1"
CONNECTIONS_MAX = 64  # simultaneous connections


class LimitedConnection(H11Protocol):
    """Connection that closes when idle. If there are too many, the one idle longest is closed."""

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self.made_s = self.loop.time()
        self._timer: asyncio.TimerHandle = self.loop.call_later(REQUEST_S, self._let_go)
        if len(self.connections) > CONNECTIONS_MAX:
            waiting = [one for one in self.connections if isinstance(one, LimitedConnection) and one.waits]
            min(waiting, key=lambda one: one.made_s).transport.abort()  # may be this one

    def connection_lost(self, exc: Exception | None) -> None:
        self._timer.cancel()
        super().connection_lost(exc)

    @property
    def waits(self) -> bool:
        """True while the connection waits for a request."""
        cycle: Any = self.cycle  # None before the first request
        return cycle is None or bool(cycle.response_complete)

    def _let_go(self) -> None:
        if self.waits and self in self.connections:  # not after an upgrade to another protocol
            self.transport.abort()


def listening(command: str, port: int) -> sockets.socket:
    """Bind a socket on loopback. Raises InputError if the port is in use."""
    try:
        return sockets.create_server((LOOPBACK, port))
    except OSError as error:
        raise InputError(command, "--port", f"cannot listen on port {port}: {error.strerror}") from None


def server_of(application: Any) -> uvicorn.Server:
    """Return a uvicorn server with the limits that all pages share."""
    return uvicorn.Server(
        uvicorn.Config(
            application,
            log_level="warning",
            access_log=False,
            server_header=False,
            proxy_headers=False,
            timeout_graceful_shutdown=2,
            http=LimitedConnection,
            ws="websockets-sansio",
            ws_max_size=REQUEST_MAX_BYTES,
            ws_per_message_deflate=False,
        )
    )
