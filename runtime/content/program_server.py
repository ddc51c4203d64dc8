"""Server for programs that draw: it passes on requests and keeps the newest pictures.

It runs an event loop on a separate thread. No caller waits for a program: `ask` only leaves a request, and a
program that reads slowly loses only its own messages. docs/programs.md describes the protocol. In a run on the real
clock, it is part of a separate process (`daemon.programs`).
"""

from __future__ import annotations

import asyncio
import hmac
import json
import logging
import mmap
import os
import socket as sockets
import struct
import threading
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed

from runtime.clock import NS_PER_S
from runtime.content.program_pictures import (
    ANSWERED_S,
    IN_FLIGHT_MAX,
    SIDES,
    AskedViews,
    DrawnPictures,
    PictureForm,
    ProgramPicture,
    SharedPlace,
)
from runtime.errors import ContentFailure, InputError, one_line
from runtime.support.background import begin
from runtime.support.channel import shared_memory
from runtime.support.untrusted_input import parsed_json

log = logging.getLogger("phasestack.content")
library_log = logging.getLogger("phasestack.websockets")  # the library describes each failed handshake by a traceback
library_log.setLevel(logging.CRITICAL)

HOST = "127.0.0.1"
GIVEN_UP_S = 2.0  # an unanswered frame is abandoned after this time
HELLO_S = 5.0  # time limit for the handshake, and for a program's greeting
CLOSED_WITHIN_S = 1.0  # time limit for a program to close its connection, after the close message
HALF_OPEN_MAX = 16  # largest number of connections without a handshake; the oldest is closed
CONNECTIONS_MAX = 32  # largest number of connected programs
QUEUED_MAX = 4  # largest number of messages that the library holds for each connection
HEAD = struct.Struct("<II")  # an answer's header: frame number and side (0 left, 1 right)
SCALE_MIN = 0.1  # smallest pictures that a program can ask to draw, as a fraction of the display's width and height
DEPTHS: dict[str, np.dtype[Any]] = {
    "uint16": np.dtype("<u2"),
    "float32": np.dtype("<f4"),
}  # pixel types of depth pictures
ENCODINGS = ("raw", "jpeg")
SLOTS = 4  # frames in shared memory: two in flight, the newest, and the one that the solver still reads
MESSAGE_MAX_BYTES = 8 * 7680 * 4320 + HEAD.size
WRONG_DATA, LEAVING, TOO_BIG = 1007, 1001, 1009  # close codes of RFC 6455


class ProgramMemory:
    """Memory that a program on the same machine can write its pictures to.

    A file in memory has no name, so it ends with the last process that uses it. The program opens it through this
    process's entry in /proc, which only the same user can do. The pictures of `SLOTS` frames fit into it, and those of
    later frames replace them.
    """

    def __init__(self, picture_bytes: int) -> None:
        """Allocate memory for pictures of at most this size. Raises OSError if that is not possible."""
        self.picture_bytes, self.bytes = picture_bytes, 2 * SLOTS * picture_bytes
        self._file = shared_memory("phasestack-program", self.bytes)
        self.path = f"/proc/{os.getpid()}/fd/{self._file}"
        self._data = memoryview(mmap.mmap(self._file, self.bytes))  # unmapped once no picture refers to it

    def place(self, frame: int, side: int, form: PictureForm) -> tuple[memoryview, SharedPlace]:
        """Return the memory and the place of a picture of the frame with this number."""
        at = (2 * (frame % SLOTS) + side) * self.picture_bytes
        return self._data[at : at + form.bytes], SharedPlace(self.path, self.bytes, at, form)

    def close(self) -> None:
        """Close the file. Pictures in the memory remain valid."""
        os.close(self._file)


@dataclass(slots=True)
class _Frame:
    """A frame requested from a program, with the pictures received so far."""

    asked: AskedViews
    asked_s: float  # request time on the monotonic clock
    form: PictureForm
    pictures: dict[int, ProgramPicture] = field(default_factory=dict)  # keyed by side
    places: dict[int, tuple[memoryview, SharedPlace]] = field(default_factory=dict)  # in shared memory, keyed by side


class _Connection(ServerConnection):
    """Connection that is closed before its handshake if many younger ones also wait for theirs."""

    def __init__(self, *args: Any, waiting: dict[_Connection, None], **options: Any) -> None:
        super().__init__(*args, **options)
        self._waiting = waiting

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        self._waiting[self] = None
        if len(self._waiting) > HALF_OPEN_MAX:
            oldest = next(iter(self._waiting))
            oldest.shaken()
            oldest.transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        self.shaken()
        super().connection_lost(exc)

    def shaken(self) -> None:
        """Declare that the connection no longer waits for its handshake."""
        self._waiting.pop(self, None)


class _Client:
    """A connected program, with the messages that it has not yet taken."""

    def __init__(self, connection: ServerConnection, hello: dict[str, Any]) -> None:
        """Read a program's first message. Raises ValueError if one of its fields is invalid."""
        self.connection = connection
        for name in ("listens", "memory"):
            if not isinstance(hello.get(name, False), bool):
                raise ValueError(f"{name} must be true or false")
        if hello.get("rows", "top-down") not in ("top-down", "bottom-up"):
            raise ValueError("rows must be top-down or bottom-up")
        self.listens = hello.get("listens", False)
        self.bottom_up = hello.get("rows") == "bottom-up"
        self.name = one_line(str(hello.get("name", "unnamed")), most=80)
        scale, depth = hello.get("scale", 1), hello.get("depth")
        if not isinstance(scale, int | float) or not SCALE_MIN <= scale <= 1:
            raise ValueError(f"scale must be a number from {SCALE_MIN} to 1")
        if depth is not None and depth not in tuple(DEPTHS):
            raise ValueError(f"depth must be {' or '.join(DEPTHS)}")
        self._encoding = hello.get("encoding", "raw")
        if self._encoding not in ENCODINGS:
            raise ValueError(f"encoding must be {' or '.join(ENCODINGS)}")
        self._scale = scale
        self._depth: np.dtype[Any] | None = None if depth is None else DEPTHS[depth]
        self._shares_memory, self._frames_shared = hello.get("memory", False), 0
        self._memory: ProgramMemory | None = None
        self.unasked = 0  # consecutive pictures for an eye that was not asked for
        self._messages: deque[str] = deque(maxlen=1 if self.listens else 2 * IN_FLIGHT_MAX)
        self._has_messages = asyncio.Event()

    def form(self, asked: AskedViews) -> PictureForm:
        """Return the size and parts of the pictures for a request."""
        width_px, height_px = (max(1, round(size * self._scale)) for size in (asked.width_px, asked.height_px))
        return PictureForm(width_px, height_px, self._depth, self.bottom_up, self._encoding)

    def request(self, number: int, frame: _Frame) -> None:
        """Leave a request for the program and, if it uses shared memory, choose the places of the pictures."""
        asked, eyes = frame.asked, list(frame.asked.eyes)
        if self._shares_memory and self._has_memory(frame.form.bytes):
            assert self._memory is not None
            self._frames_shared += 1
            for n, side in enumerate(asked.sides):
                frame.places[side] = self._memory.place(self._frames_shared, side, frame.form)
                eyes[n] = eyes[n] | {"at": frame.places[side][1].at}
        self.post(_message(number, asked, frame.form.width_px, frame.form.height_px, eyes))

    def _has_memory(self, picture_bytes: int) -> bool:
        """Ensure that there is enough shared memory, and send its path to the program if it is new."""
        if self._memory is None or self._memory.picture_bytes < picture_bytes:
            self.close()
            try:
                self._memory = ProgramMemory(picture_bytes)
            except OSError as error:
                log.warning("no memory can be shared with the program: %s", error.strerror)
                self._shares_memory = False
                return False
            self.post(json.dumps({"memory": {"path": self._memory.path, "bytes": self._memory.bytes}}))
        return True

    def close(self) -> None:
        """Release the shared memory."""
        if self._memory is not None:
            self._memory.close()
            self._memory = None

    def post(self, message: str) -> None:
        """Leave a message for the program. A message that is not taken in time is replaced by later ones."""
        self._messages.append(message)
        self._has_messages.set()

    async def send(self) -> None:
        """Send messages as fast as the program reads them, until the connection is closed."""
        with suppress(ConnectionClosed):
            while True:
                await self._has_messages.wait()
                self._has_messages.clear()
                while self._messages:
                    await self.connection.send(self._messages.popleft())


class ProgramServer:
    """Server that drawing programs connect to in order to receive requests and send pictures. The program
    that connected last does the drawing. Programs that only listen receive the same requests. The methods may be called
    on any thread. None waits for a program, except for `drawn`.
    """

    def __init__(self, port: int, token: str) -> None:
        """Listen on a loopback TCP port, 0 for any; an address must contain the token. Raises OSError if that fails."""
        self._token = token
        self._changed = threading.Condition()  # guards the fields below, up to `_socket`
        self._drawing: _Client | None = None  # latest drawing program
        self._frames: dict[int, _Frame] = {}  # requested frames that are incomplete, keyed by number
        self._count = 0
        self.newest: DrawnPictures | None = None
        self.problem = ""  # why the last program was lost; empty: none was
        self.frame_ms: float | None = None  # time from a recent request to the last picture in the answer
        self._socket = sockets.create_server((HOST, port))
        self.port: int = self._socket.getsockname()[1]
        self.address = f"ws://{HOST}:{self.port}/?token={token}"
        self._clients: set[_Client] = set()  # used on the loop's thread only, as is everything below
        self._waiting: dict[_Connection, None] = {}  # connections without a handshake, oldest first
        self._closing: set[asyncio.Task[None]] = set()
        self._ends = asyncio.Event()
        self._loop = asyncio.new_event_loop()
        begin("programs", self._run)
        log.info(
            "waiting for a program to connect; `phasestack status` shows the address to connect to under `program`"
        )

    def ask(self, asked: AskedViews) -> int:
        """Request a frame's pictures, and return its number. Raises ContentFailure."""
        now_s = time.monotonic()
        with self._changed:
            self._count += 1
            number, program = self._count, self._drawing
            self._frames = {n: frame for n, frame in self._frames.items() if now_s - frame.asked_s < GIVEN_UP_S}
            is_asked = program is not None and len(self._frames) < IN_FLIGHT_MAX
            if is_asked:
                assert program is not None
                self._frames[number] = _Frame(asked, now_s, program.form(asked))
        self._call(self._post, number, asked, program if is_asked else None)
        if program is None:
            why = f" ({self.problem})" if self.problem else ""
            raise ContentFailure(
                f"no program is connected{why}; `phasestack status` shows the address to connect to under `program`"
            )
        if not is_asked:
            raise ContentFailure(f"the program is late: {IN_FLIGHT_MAX} requests are unanswered")
        return number

    def drawn(self, number: int) -> DrawnPictures:
        """Wait for a frame. Raises ContentFailure if it takes over `ANSWERED_S` or the program disconnects."""
        with self._changed:
            frame = self._frames.get(number)
            if frame is not None:
                within_s = frame.asked_s + ANSWERED_S - time.monotonic()
                self._changed.wait_for(lambda: number not in self._frames, within_s)
            if self.newest is not None and self.newest.number == number:
                return self.newest
        raise ContentFailure(self.problem or f"the program did not answer within {1e3 * ANSWERED_S:.0f} ms")

    def close(self) -> None:
        """Close the port and all connections, soon."""
        self._call(self._ends.set)

    def _call(self, function: Any, *args: Any) -> None:
        with suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(function, *args)

    # On the loop's thread

    def _run(self) -> None:
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
            runner.run(self._serve())

    async def _serve(self) -> None:
        """Accept connections until the end. After an error such as too many open files, asyncio accepts again."""
        options: dict[str, Any] = {
            "create_connection": partial(_Connection, waiting=self._waiting),
            "server_header": None,
            "logger": library_log,
        }
        async with serve(
            self._connected,
            sock=self._socket,
            process_request=self._refused,
            open_timeout=HELLO_S,
            close_timeout=CLOSED_WITHIN_S,
            max_size=MESSAGE_MAX_BYTES,
            max_queue=QUEUED_MAX,
            # Some programs' libraries drop a connection whose server selects none of the subprotocols that they offer.
            select_subprotocol=lambda _, offered: next(iter(offered), None),
            compression=None,
            **options,
        ):
            await self._ends.wait()
            for connection in tuple(self._waiting):
                connection.transport.abort()

    def _refused(self, connection: Any, request: Any) -> Any:
        token = parse_qs(urlsplit(request.path).query).get("token", [""])[0]
        if not hmac.compare_digest(token.encode(), self._token.encode()):
            return connection.respond(403, "the token in the address is wrong\n")
        if len(self._clients) >= CONNECTIONS_MAX:
            return connection.respond(503, f"{CONNECTIONS_MAX} programs are connected\n")
        connection.shaken()
        return None

    def _post(self, number: int, asked: AskedViews, program: _Client | None) -> None:
        listeners = [client for client in self._clients if client.listens]
        if listeners:
            message = _message(number, asked, asked.width_px, asked.height_px, asked.eyes)
            for client in listeners:
                client.post(message)
        frame = self._frames.get(number)
        if program in self._clients and frame is not None:
            assert program is not None
            program.request(number, frame)

    async def _connected(self, connection: ServerConnection) -> None:
        """Serve a connection. A program's first message states whether it draws or only listens."""
        client: _Client | None = None
        why = "the program closed the connection"
        try:
            client = _Client(connection, await _greeting(connection))
            self._welcome(client)
            sending = asyncio.ensure_future(client.send())
            try:
                async for message in connection:
                    self._take(client, message)
            finally:
                sending.cancel()
        except ConnectionClosed as error:
            if error.sent is not None and error.sent.code == TOO_BIG:
                why = f"a message is larger than {MESSAGE_MAX_BYTES} bytes"
        except ValueError as error:
            why = one_line(str(error), most=100)
            self._lose(client, why)
            await connection.close(WRONG_DATA, _shortened(why))
        finally:
            self._lose(client, why)

    def _welcome(self, client: _Client) -> None:
        self._clients.add(client)
        if client.listens:
            return
        with self._changed:
            before, self._drawing = self._drawing, client
            self.problem = ""
            self._frames.clear()
            self._changed.notify_all()
        log.info("drawing program connected: %s", client.name)
        if before is not None:
            closing = asyncio.ensure_future(
                before.connection.close(LEAVING, _shortened(f"another program has replaced it: {client.name}"))
            )
            self._closing.add(closing)
            closing.add_done_callback(self._closing.discard)

    def _lose(self, client: _Client | None, why: str) -> None:
        """Forget a client. Has no effect if it was forgotten before."""
        if client is not None:
            self._clients.discard(client)
            client.close()
        with self._changed:
            if client is None or self._drawing is not client:
                return
            self._drawing, self.problem = None, why
            self.newest = None  # so that shared memory is released
            self._frames.clear()
            self._changed.notify_all()
        log.warning("lost the drawing program: %s", why)

    def _take(self, client: _Client, message: str | bytes) -> None:
        """Store a picture from a program. Raises ValueError if the message is not a picture that was asked for."""
        if client.listens:
            return
        if not isinstance(message, bytes) or len(message) < HEAD.size:
            raise ValueError("the answer is not a picture")
        number, side = HEAD.unpack_from(message)
        with self._changed:
            frame = self._frames.get(number)
        is_asked = frame is None or side in frame.asked.sides
        client.unasked = (
            0 if is_asked else client.unasked + 1
        )  # once: a program may draw both eyes, the right one first
        if side >= len(SIDES) or client.unasked > 1:
            raise ValueError(f"the answer is for eye {side}; the left eye is 0 and the right eye is 1")
        if client is not self._drawing or frame is None or not is_asked:
            return  # the frame was abandoned
        data = memoryview(message)[HEAD.size :]
        in_memory = not data and side in frame.places
        frame.pictures[side] = frame.form.picture(*frame.places[side]) if in_memory else frame.form.received(data)
        if len(frame.pictures) == len(frame.asked.eyes):
            self._complete(number, frame)

    def _complete(self, number: int, frame: _Frame) -> None:
        with self._changed:
            if number not in self._frames:
                return
            # A program that answers a frame has given up those before it.
            self._frames = {n: one for n, one in self._frames.items() if n > number}
            self.frame_ms = 1e3 * (time.monotonic() - frame.asked_s)
            if self.newest is None or number > self.newest.number:
                self.newest = DrawnPictures(number, frame.pictures)
            self._changed.notify_all()


async def _greeting(connection: ServerConnection) -> dict[str, Any]:
    """Return a program's first message. Raises ValueError if it is not a JSON object, or late."""
    try:
        async with asyncio.timeout(HELLO_S):
            hello = parsed_json(await connection.recv(), source="the first message")
    except TimeoutError:
        raise ValueError(f"no first message within {HELLO_S:g} s") from None
    except InputError as error:
        raise ValueError(str(error)) from None
    if not isinstance(hello, dict):
        raise ValueError("the first message is not a JSON object")
    return hello


def _message(number: int, asked: AskedViews, width_px: int, height_px: int, eyes: Sequence[dict[str, Any]]) -> str:
    """Return the request for a frame, as sent to a program."""
    size = {"width": width_px, "height": height_px, "display_m": asked.display_m}
    return json.dumps({"frame": number, "time_s": asked.time_ns / NS_PER_S, **size, "eyes": eyes})


def _shortened(why: str) -> str:
    """Return a reason that fits in a close message, which holds 123 bytes."""
    return why.encode("ascii", "replace").decode()[:120]
