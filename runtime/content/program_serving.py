"""Serve drawing programs, in the solver's process or in a separate one."""

from __future__ import annotations

import secrets
import threading
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

from runtime.content.program_link import (
    SENT_S,
    AskFrame,
    CloseServer,
    FrameAnswer,
    OpenServer,
    Server,
    ServerAddress,
    ServerState,
    link,
)
from runtime.content.program_pictures import IN_FLIGHT_MAX, PictureForm, ProgramPicture, SharedPlace
from runtime.content.program_server import ProgramMemory, ProgramServer
from runtime.errors import ContentFailure, InputError
from runtime.support.channel import Channel


class Serving:
    """Servers in a separate process, as instructed by a solver's `ProgramLink`."""

    def __init__(self, channel: Channel, token: str) -> None:
        self._channel, self._token = channel, token
        self._servers: dict[int, ProgramServer] = {}  # keyed by the port asked for
        self._addresses: dict[int, str] = {}  # address of the last server, keyed likewise
        self._telling = threading.Lock()  # held from reading a state until it is sent, so that the newest is sent last
        self._told: dict[int, ServerState] = {}  # latest state that was sent, keyed likewise
        self._waiters = ThreadPoolExecutor(IN_FLIGHT_MAX + 1, "programs' answers")
        self._lock = threading.Lock()  # for the fields below
        self._memory: ProgramMemory | None = None  # for pictures that programs have sent
        self._frames_shared = 0

    def take(self, timeout_s: float) -> None:
        """Carry out the solver's instructions that have arrived, or wait for one."""
        for message in self._channel.receive(timeout_s):
            match message:
                case OpenServer(port):
                    self._told.pop(port, None)  # because another solver may ask
                    self._send(self._opened(port, self._addresses.get(port, "")))
                case CloseServer(port) if port in self._servers:
                    self._servers.pop(port).close()
                    with self._lock:
                        self._release()
                case AskFrame():
                    self._ask(message)
        for port, server in self._servers.items():
            self._tell(port, server)

    def _opened(self, port: int, address: str) -> ServerAddress:
        """Open a server, if it is not open, where it was before this process, and return its state."""
        try:
            if port not in self._servers:
                self._servers[port] = opened(port, self._token, address)
                self._addresses[port] = self._servers[port].address
        except InputError as error:
            return ServerAddress(port, "", error.problem)
        return ServerAddress(port, self._servers[port].address, "")

    def _ask(self, ask: AskFrame) -> None:
        opened, server = self._opened(ask.port, ask.address), self._servers.get(ask.port)
        if server is None:
            self._send(FrameAnswer(ask.number, {}, opened.problem))
            return
        try:
            number = server.ask(ask.asked)
        except ContentFailure as error:
            self._send(FrameAnswer(ask.number, {}, str(error)))
        else:
            self._waiters.submit(self._answer, ask, server, number)

    def _answer(self, ask: AskFrame, server: ProgramServer, number: int) -> None:
        try:
            pictures, why = self._in_memory(server.drawn(number).pictures), ""
        except (ContentFailure, OSError) as error:
            pictures, why = {}, str(error)
        self._tell(ask.port, server)
        self._send(FrameAnswer(ask.number, pictures, why))

    def _in_memory(self, pictures: Mapping[int, ProgramPicture]) -> dict[int, SharedPlace]:
        """Return where pictures are in shared memory, after copying those that were sent. Raises OSError.

        Memory that is used again takes a third of the time that new memory in each message would.
        """
        places = {side: picture.place for side, picture in pictures.items() if picture.place is not None}
        with self._lock:
            self._frames_shared += 1
            for side in pictures.keys() - places.keys():
                picture, (height_px, width_px) = pictures[side], pictures[side].pixels.shape[:2]
                depth = None if picture.depth is None else picture.depth.dtype
                form = PictureForm(width_px, height_px, depth, bottom_up=False)
                if self._memory is None or self._memory.picture_bytes < form.bytes:
                    self._release()
                    self._memory = ProgramMemory(form.bytes)
                memory, places[side] = self._memory.place(self._frames_shared, side, form)
                form.picture(memory).replace(picture)
        return places

    def _release(self) -> None:
        if self._memory is not None:
            self._memory.close()
            self._memory = None

    def _tell(self, port: int, server: ProgramServer) -> None:
        with self._telling:
            state = ServerState(port, server.problem, server.frame_ms)
            if self._told.get(port) != state and self._channel.send(state, timeout_s=SENT_S):
                self._told[port] = state

    def _send(self, message: ServerAddress | FrameAnswer) -> None:
        self._channel.send(message, timeout_s=SENT_S)


def opened(port: int, token: str, address: str = "") -> ProgramServer:
    """Open a server on a TCP port, 0 for any, if possible where it was. Raises InputError."""
    before = int(address.partition("/?")[0].rpartition(":")[2] or port)
    problem = ""
    for attempt in (before, port):
        try:
            return ProgramServer(attempt, token)
        except OSError as error:
            problem = f"cannot listen on port {attempt}: {error.strerror}"
    raise InputError("content.options", "port", problem)


_lock = threading.Lock()
_token = secrets.token_urlsafe(24)  # of servers in this process
_servers: dict[int, tuple[Server, int]] = {}  # open servers and their numbers of users, keyed by the port asked for
_addresses: dict[int, str] = {}  # address of the last server, keyed by the port asked for


def acquire(port: int) -> Server:
    """Return the server for a TCP port, 0 for any, which the caller must `release`. Raises InputError if
    it cannot be opened. The address, with the token, stays the same for the life of the server's process if the port is
    still free, so that programs find the server again after a change of the scene.
    """
    with _lock:
        server, users = _servers.get(port, (None, 0))
        if server is None:
            server = elsewhere.open(port) if (elsewhere := link()) else opened(port, _token, _addresses.get(port, ""))
            _addresses[port] = server.address
        _servers[port] = server, users + 1
        return server


def release(server: Server) -> None:
    """Give back a server. It is closed when its last user has given it back."""
    with _lock:
        for port, (one, users) in tuple(_servers.items()):
            if one is server:
                if users > 1:
                    _servers[port] = server, users - 1
                    return
                del _servers[port]
    with suppress(OSError):
        server.close()
