"""Requests over a local socket, each within a deadline: one thread, a bounded number of connections, no waiting.

Whoever trickles, hangs or comes in crowds holds up nobody: a request has so long to arrive, a connection so long to
live, and where all places are taken the one that has waited longest for a whole request goes.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import selectors
import socket
import threading
from dataclasses import dataclass
from typing import Any, Protocol

from runtime.clock import NS_PER_S, MonotonicClock
from runtime.support.priority import BACKGROUND_NICENESS, set_niceness

log = logging.getLogger("phasestack.service")

BACKLOG = 64
ACCEPTED_AT_ONCE = 16  # before those that are there are looked at again
PENDING_LOOK_S = 0.01  # between two looks whether an answer is there
ACCEPT_PAUSE_S = 0.2  # after the system refused a descriptor or memory
RECEIVED_BYTES = 65536
NO_ROOM = (errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.ENOBUFS)


class Pending(Protocol):
    """An answer that is not there yet."""

    def poll(self) -> bytes | None:
        """The answer, once it is there. Never waits."""

    def abandon(self) -> bytes:
        """The answer where the server stops first."""


class Service(Protocol):
    """What the requests are."""

    one_request: bool  # a connection is closed after its first answer

    def cut(self, received: bytes, *, ended: bool) -> tuple[bytes, bytes] | None:
        """The first whole request, and what follows it; None: it is not whole yet. ended: nothing more will come."""

    def answer(self, request: bytes) -> bytes | Pending:
        """What the client is sent. Quick: it holds up the other clients."""

    def refusal(self, why: str) -> bytes:
        """What a client is sent that is not served."""


@dataclass(frozen=True, slots=True)
class Limits:
    """What one client may take."""

    clients: int = 64
    request_bytes: int = 65536
    request_s: float = 5.0  # from the answer before (or the connection) to the whole request, and for the answer's way
    connection_s: float = 60.0  # after this a connection gets no more answers than the one that is under way


class _Connection:
    """One client."""

    def __init__(self, channel: socket.socket, *, now_ns: int) -> None:
        self.channel, self.begun_ns, self.since_ns = channel, now_ns, now_ns
        self.received, self.to_send = b"", b""
        self.pending: Pending | None = None
        self.ended = self.last = False  # the client sends no more; it gets no more

    @property
    def reading(self) -> bool:
        """It waits for a request."""
        return self.pending is None and not self.to_send


class RequestServer:
    """Serves a listening socket, which it owns from now on, until `close`."""

    def __init__(self, listening: socket.socket, service: Service, limits: Limits | None = None, *, name: str) -> None:
        """listening: bound; name: of the thread."""
        self._listening, self._service, self._limits = listening, service, limits or Limits()
        self._clock = MonotonicClock()
        self._connections: dict[socket.socket, _Connection] = {}
        self._accept_from_ns = 0
        self._stopping = threading.Event()
        self._address = listening.getsockname()
        listening.setblocking(False)
        listening.listen(BACKLOG)
        self._woken, self._wake = socket.socketpair()
        self._woken.setblocking(False)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._woken, selectors.EVENT_READ)
        self._selector.register(listening, selectors.EVENT_READ)
        self._listens = True
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def address(self) -> Any:
        """Of the listening socket."""
        return self._address

    @property
    def connections(self) -> int:
        """Clients that are connected now."""
        return len(self._connections)

    def close(self) -> None:
        """Answer what waits, as abandoned, and stop. May be called twice."""
        if not self._stopping.is_set():
            self._stopping.set()
            with contextlib.suppress(OSError):
                self._wake.send(b"x")
            self._thread.join(timeout=2.0)

    def _run(self) -> None:
        set_niceness(BACKGROUND_NICENESS)
        try:
            while not self._stopping.is_set():
                try:
                    self._turn()
                except Exception:
                    log.exception("the clients' turn failed")
                    self._stopping.wait(ACCEPT_PAUSE_S)
        finally:
            self._release()

    def _turn(self) -> None:
        ready = {key.fileobj for key, _ in self._selector.select(self._wait_s())}
        # Who has sent its request goes first: nobody who comes now takes its place.
        for connection in list(self._connections.values()):
            if connection.channel in ready or connection.pending is not None:
                self._advance(connection)
        self._end_overdue()
        if self._listening in ready:
            self._accept()
        self._listen_again()

    def _wait_s(self) -> float:
        waits = [0.5]
        now_ns = self._clock.now_ns()
        for connection in self._connections.values():
            if connection.pending is not None:
                return PENDING_LOOK_S
            waits.append((self._deadline_ns(connection) - now_ns) / NS_PER_S)
        if not self._listens:
            waits.append((self._accept_from_ns - now_ns) / NS_PER_S)
        return max(0.0, min(waits))

    def _deadline_ns(self, connection: _Connection) -> int:
        request_ns = connection.since_ns + round(self._limits.request_s * NS_PER_S)
        return min(request_ns, connection.begun_ns + round(self._limits.connection_s * NS_PER_S))

    def _accept(self) -> None:
        for _ in range(ACCEPTED_AT_ONCE):
            try:
                channel, _ = self._listening.accept()
            except BlockingIOError:
                return
            except OSError as error:
                if error.errno not in NO_ROOM:
                    continue
                log.warning("a client could not be let in (%s)", error.strerror)
                self._make_room()
                self._selector.unregister(self._listening)
                self._listens = False
                self._accept_from_ns = self._clock.now_ns() + round(ACCEPT_PAUSE_S * NS_PER_S)
                return
            channel.setblocking(False)
            if len(self._connections) >= self._limits.clients and not self._make_room():
                with contextlib.suppress(OSError):
                    channel.send(self._service.refusal("too many clients"))
                channel.close()
                continue
            self._connections[channel] = _Connection(channel, now_ns=self._clock.now_ns())
            self._selector.register(channel, selectors.EVENT_READ)

    def _listen_again(self) -> None:
        if not self._listens and self._clock.now_ns() >= self._accept_from_ns:
            self._selector.register(self._listening, selectors.EVENT_READ)
            self._listens = True

    def _make_room(self) -> bool:
        """End the connection that has waited longest for a whole request; False: all are being answered."""
        waiting = [connection for connection in self._connections.values() if connection.reading]
        if not waiting:
            return False
        self._refuse(min(waiting, key=lambda connection: connection.since_ns), "too many clients")
        return True

    def _end_overdue(self) -> None:
        now_ns = self._clock.now_ns()
        for connection in list(self._connections.values()):
            if connection.pending is None and now_ns > self._deadline_ns(connection):
                self._refuse(connection, "the request did not come in time")

    def _advance(self, connection: _Connection) -> None:
        """Send, receive and answer as far as it goes without waiting."""
        try:
            if connection.reading:
                self._receive(connection)
            elif connection.pending is not None:
                answer = connection.pending.poll()
                if answer is not None:
                    connection.pending = None
                    self._send(connection, answer)
            else:
                self._send(connection, b"")
            while connection.reading and not connection.last and self._next_request(connection):
                pass
        except OSError:
            self._end(connection)
            return
        if connection.reading and (connection.last or connection.ended):
            self._end(connection)
        else:
            self._watch(connection)

    def _receive(self, connection: _Connection) -> None:
        try:
            data = connection.channel.recv(RECEIVED_BYTES)
        except BlockingIOError:
            return
        connection.received += data
        connection.ended = not data

    def _next_request(self, connection: _Connection) -> bool:
        """Answer the next whole request; False: there is none."""
        cut = self._service.cut(connection.received, ended=connection.ended)
        waiting = connection.received if cut is None else cut[0]
        if len(waiting) > self._limits.request_bytes:
            connection.last, connection.received = True, b""
            self._send(connection, self._service.refusal("the request is too long"))
            return True
        if cut is None:
            return False
        request, connection.received = cut
        connection.last = self._service.one_request
        try:
            answer = self._service.answer(request)
        except Exception:
            log.exception("a request could not be answered")
            answer = self._service.refusal("the request could not be answered: see the log")
        if isinstance(answer, bytes):
            self._send(connection, answer)
        else:
            connection.pending = answer
        return True

    def _send(self, connection: _Connection, data: bytes) -> None:
        connection.to_send += data
        with contextlib.suppress(BlockingIOError):
            while connection.to_send:
                connection.to_send = connection.to_send[connection.channel.send(connection.to_send) :]
        if data or not connection.to_send:
            connection.since_ns = self._clock.now_ns()

    def _watch(self, connection: _Connection) -> None:
        """Wake up for what the connection waits for."""
        events = selectors.EVENT_READ if connection.reading else selectors.EVENT_WRITE if connection.to_send else 0
        watched = connection.channel in self._selector.get_map()
        if events and watched:
            self._selector.modify(connection.channel, events)
        elif events:
            self._selector.register(connection.channel, events)
        elif watched:
            self._selector.unregister(connection.channel)

    def _refuse(self, connection: _Connection, why: str) -> None:
        with contextlib.suppress(OSError):
            if not connection.to_send:
                connection.channel.send(self._service.refusal(why))
        self._end(connection)

    def _end(self, connection: _Connection) -> None:
        self._connections.pop(connection.channel, None)
        if connection.channel in self._selector.get_map():
            self._selector.unregister(connection.channel)
        connection.channel.close()

    def _release(self) -> None:
        for connection in list(self._connections.values()):
            if connection.pending is not None:
                with contextlib.suppress(OSError):
                    connection.channel.send(connection.pending.abandon())
            self._end(connection)
        self._selector.close()
        for channel in (self._listening, self._woken, self._wake):
            channel.close()
