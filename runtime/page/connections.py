"""Limit a uvicorn server's connections, because idle connections must not block others."""

from __future__ import annotations

import asyncio
import socket as sockets
from typing import Any

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from runtime.daemon.client import REQUEST_MAX_BYTES, REQUEST_S
from runtime.errors import InputError

LOOPBACK = "127.0.0.1"
CONNECTIONS_MAX = 64  # maximum number of simultaneous connections


class LimitedConnection(H11Protocol):
    """HTTP connection that is closed if it is still waiting longer than `REQUEST_S` for a request. The
    wait begins when the connection is opened, and again after each answer. If there are more than `CONNECTIONS_MAX`
    connections, the one that has waited longest is closed.
    """

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self._begin_wait()
        if len(self.connections) > CONNECTIONS_MAX:
            waiting = [one for one in self.connections if isinstance(one, LimitedConnection) and one.waits]
            min(waiting, key=lambda one: one.waits_since_s).transport.abort()  # perhaps this one

    def on_response_complete(self) -> None:
        super().on_response_complete()
        self._timer.cancel()
        self._begin_wait()

    def connection_lost(self, exc: Exception | None) -> None:
        self._timer.cancel()
        super().connection_lost(exc)

    @property
    def waits(self) -> bool:
        """True if the connection is waiting for a request."""
        cycle: Any = self.cycle  # None before the first request
        return cycle is None or bool(cycle.response_complete)

    def _begin_wait(self) -> None:
        self.waits_since_s = self.loop.time()
        self._timer: asyncio.TimerHandle = self.loop.call_later(REQUEST_S, self._let_go)

    def _let_go(self) -> None:
        if self.waits and self in self.connections:  # not if it has been upgraded to another protocol
            self.transport.abort()


def listening(command: str, port: int) -> sockets.socket:
    """Return a socket that listens on a loopback port. Raises InputError, which names the command."""
    try:
        return sockets.create_server((LOOPBACK, port))
    except OSError as error:
        raise InputError(command, "--port", f"cannot listen on port {port}: {error.strerror}") from None


def server_of(application: Any) -> uvicorn.Server:
    """Return a uvicorn server for an ASGI application, with the limits used for all pages."""
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
