"""Link between a solver and the process that serves drawing programs while solvers change."""

from __future__ import annotations

import mmap
import os
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from runtime.content.program_pictures import (
    ANSWERED_S,
    IN_FLIGHT_MAX,
    AskedViews,
    DrawnPictures,
    ProgramPicture,
    SharedPlace,
)
from runtime.errors import ContentFailure, InputError
from runtime.support.channel import Channel

OPENED_S = 20.0  # time limit for opening a port, which may start a process
LATE_S = 0.25  # how much later than a server's own time limit its answer may arrive
SENT_S = 0.25  # time limit for the other process to read


class Server(Protocol):
    """A server as its users see it. `ProgramServer` describes the members."""

    @property
    def address(self) -> str: ...
    @property
    def problem(self) -> str: ...
    @property
    def frame_ms(self) -> float | None: ...
    def ask(self, asked: AskedViews) -> int: ...
    def drawn(self, number: int) -> DrawnPictures: ...
    def close(self) -> None: ...


@dataclass(frozen=True, slots=True)
class OpenServer:
    """Open the server for a port, which may be open. Answered by `ServerAddress`."""

    port: int  # as asked for by the user; 0: any


@dataclass(frozen=True, slots=True)
class ServerAddress:
    """Address of the server for a port."""

    port: int  # as asked for
    address: str
    problem: str  # why it cannot be opened; empty: it is open


@dataclass(frozen=True, slots=True)
class CloseServer:
    """Close the server for a port. Not answered."""

    port: int


@dataclass(frozen=True, slots=True)
class AskFrame:
    """Ask a server for a frame. Answered by `FrameAnswer`."""

    port: int
    address: str  # where the server is expected, and opened if it is not
    number: int
    asked: AskedViews


@dataclass(frozen=True, slots=True)
class FrameAnswer:
    """A frame's pictures, or why there are none."""

    number: int
    pictures: Mapping[int, SharedPlace]  # keyed by side; empty: none
    why: str


@dataclass(frozen=True, slots=True)
class ServerState:
    """State of a server, sent when it changes and before any answer (`ProgramServer`)."""

    port: int
    problem: str = ""
    frame_ms: float | None = None


class LinkedServer:
    """A server in another process."""

    def __init__(self, link: ProgramLink, port: int, address: str) -> None:
        self._link, self._port, self.address = link, port, address

    @property
    def problem(self) -> str:
        return self._link.state(self._port).problem

    @property
    def frame_ms(self) -> float | None:
        return self._link.state(self._port).frame_ms

    def ask(self, asked: AskedViews) -> int:
        return self._link.ask(self._port, self.address, asked)

    def drawn(self, number: int) -> DrawnPictures:
        answer = self._link.answer(number)
        if answer is None:
            raise ContentFailure("the process that serves drawing programs does not answer")
        if not answer.pictures:
            raise ContentFailure(answer.why)
        return DrawnPictures(number, {side: self._link.mapped(place) for side, place in answer.pictures.items()})

    def close(self) -> None:
        self._link.close(self._port)


class ProgramLink:
    """The solver's end of a channel to the process that serves programs. Thread-safe."""

    def __init__(self, channel: Channel) -> None:
        self._channel, self._lock = channel, threading.Lock()
        self._number = time.monotonic_ns()  # of the latest frame; differs from all numbers of an earlier solver
        self._opened: dict[int, ServerAddress] = {}  # keyed by the port asked for
        self._states: dict[int, ServerState] = {}  # keyed likewise
        self._answers: dict[int, FrameAnswer | None] = {}  # keyed by number; None: not answered
        self._memory: dict[tuple[int, int], memoryview] = {}  # keyed by device and inode

    def open(self, port: int) -> LinkedServer:
        """Open the server for a port. Raises InputError."""
        with self._lock:
            self._opened.pop(port, None)
            self.send(OpenServer(port))
            ends_s = time.monotonic() + OPENED_S
            while port not in self._opened and time.monotonic() < ends_s:
                self._receive(SENT_S)
            opened = self._opened.get(
                port, ServerAddress(port, "", "the process that serves programs cannot be started")
            )
        if opened.problem:
            raise InputError("content.options", "port", opened.problem)
        return LinkedServer(self, port, opened.address)

    def close(self, port: int) -> None:
        """Close the server for a port."""
        self._memory = {}
        self.send(CloseServer(port))

    def ask(self, port: int, address: str, asked: AskedViews) -> int:
        """Request a frame's pictures, and return its number."""
        with self._lock:
            self._number += 1
            self._answers = {number: a for number, a in self._answers.items() if number > self._number - IN_FLIGHT_MAX}
            self._answers[self._number] = None
            self.send(AskFrame(port, address, self._number, asked))
            return self._number

    def answer(self, number: int) -> FrameAnswer | None:
        """Wait for the answer to a request, or return None if it is late."""
        ends_s = time.monotonic() + ANSWERED_S + LATE_S
        with self._lock:
            while self._answers.get(number) is None and number in self._answers and time.monotonic() < ends_s:
                self._receive(ends_s - time.monotonic())
            return self._answers.get(number)

    def state(self, port: int) -> ServerState:
        """Return the latest state of the server for a port."""
        with self._lock:
            self._receive(0.0)
            return self._states.get(port) or ServerState(port)

    def send(self, message: Any) -> None:
        """Send a message. One that is not read in time is lost, as one that a crash loses."""
        self._channel.send(message, timeout_s=SENT_S)

    def _receive(self, timeout_s: float) -> None:
        for message in self._channel.receive(max(timeout_s, 0.0)):
            match message:
                case ServerAddress():
                    self._opened[message.port] = message
                case ServerState():
                    self._states[message.port] = message
                    if message.problem:  # the program is gone, and its memory is not used again
                        self._memory = {}
                case FrameAnswer() if message.number in self._answers:
                    self._answers[message.number] = message

    def mapped(self, place: SharedPlace) -> ProgramPicture:
        """Return a picture in memory that a program shares. Raises ContentFailure if that is gone."""
        try:
            file = os.open(place.path, os.O_RDONLY)
            try:
                status = os.fstat(file)
                key = status.st_dev, status.st_ino
                if key not in self._memory:
                    self._memory = {key: memoryview(mmap.mmap(file, place.memory_bytes, prot=mmap.PROT_READ))}
            finally:
                os.close(file)
            return place.form.picture(self._memory[key][place.at : place.at + place.form.bytes])
        except (OSError, ValueError) as error:
            raise ContentFailure(f"the program's shared memory cannot be read: {error}") from error


_link: ProgramLink | None = None


def use(channel: Channel) -> None:
    """Use the servers of the process at the other end of a channel, from now on."""
    global _link
    _link = ProgramLink(channel)


def link() -> ProgramLink | None:
    """Return the link in use, or None: programs are served in this process."""
    return _link
