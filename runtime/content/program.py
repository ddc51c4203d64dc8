"""Show pictures from another program (renderer, game, web page) that answers requests for them.

The protocol is in docs/programs.md. If an answer is late or missing, the last pictures stay.
"""

from __future__ import annotations

import hmac
import json
import logging
import secrets
import struct
import threading
import time
import weakref
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np
from pydantic import Field
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection, serve

from runtime.clock import NS_PER_S
from runtime.config import Section, validated
from runtime.content.base import ContentInfo, ContentSource, View
from runtime.content.placing import SceneFile
from runtime.errors import ContentFailure, InputError, one_line
from runtime.records import U8
from runtime.support.background import begin

log = logging.getLogger("phasestack.content")

HOST = "127.0.0.1"
ANSWERED_S = 0.4  # time limit for both pictures of a frame
GIVEN_UP_S = 2.0  # a late frame is abandoned after this time, and another may be requested
IN_FLIGHT_MAX = 2  # largest number of frames that are requested and not yet answered
HELLO_S = 5.0  # time limit for a program's greeting
NEAR_M, FAR_M = 0.05, 100.0
HEAD = struct.Struct("<II")  # of an answer: frame number and side (0 left, 1 right)
SIDES = ("left", "right")


class ProgramOptions(Section):
    """Options for the scene `program` in [content.options]."""

    port: int = Field(0, ge=0, le=65535, description="TCP port to listen on; 0 for any free port")


def prepare(file: SceneFile) -> Callable[[Any], ContentSource]:
    """Start listening for programs. Raises InputError if the port is in use."""
    options = validated(ProgramOptions, file.settings.options, source="content.options")
    size_px = file.stack.width_px * file.stack.height_px
    source = ProgramSource(Programs(options.port, most_bytes=8 * size_px + HEAD.size), background=file.background)
    return lambda context: source


def camera_of(view: View) -> dict[str, Any]:
    """Return the OpenGL view and projection matrices of a view: column-major, depth -1 to 1, metres."""
    pixels = view.pixels_from_stack
    forward = pixels[2, :3] / np.linalg.norm(pixels[2, :3])
    right, down = (row[:3] - (row[:3] @ forward) * forward for row in pixels[:2])
    camera = np.eye(4)
    camera[:3, :3] = [right / np.linalg.norm(right), -down / np.linalg.norm(down), -forward]
    camera[:3, 3] = -camera[:3, :3] @ view.eye_m
    clip = np.zeros((4, 4))
    clip[0] = 2 / view.width_px * pixels[0] - pixels[2]
    clip[1] = pixels[2] - 2 / view.height_px * pixels[1]
    clip[2] = (FAR_M + NEAR_M) / (FAR_M - NEAR_M) * pixels[2]
    clip[2, 3] -= 2 * FAR_M * NEAR_M / (FAR_M - NEAR_M)
    clip[3] = pixels[2]
    matrices = {"view": camera, "projection": clip @ np.linalg.inv(camera)}
    return {"eye": SIDES[view.side], "eye_m": view.eye_m.tolist()} | {
        k: m.T.ravel().tolist() for k, m in matrices.items()
    }


@dataclass(slots=True)
class _Frame:
    """Request to a program for one frame."""

    views: Sequence[View]
    asked_s: float
    pictures: dict[int, U8] = field(default_factory=dict)  # by side
    awaited: bool = True  # `answer` may still be called for it

    @property
    def complete(self) -> bool:
        return len(self.pictures) == len(self.views)


class Programs:
    """Connections to drawing programs, and their answers. Thread-safe."""

    def __init__(self, port: int, *, most_bytes: int) -> None:
        """Listen on a port. Raises InputError if it is in use. most_bytes: size limit of a message."""
        self._token = secrets.token_urlsafe(24)
        self._changed = threading.Condition()
        self._drawing: ServerConnection | None = None  # the newest connection that draws
        self._listening: set[ServerConnection] = set()
        self._frames: dict[int, _Frame] = {}  # unanswered frames by number
        self._count, self._bottom_up = 0, False
        self.problem = ""
        self.frame_ms: float | None = None  # recent time from a request to its last picture
        try:
            self._server = serve(
                self._connected, HOST, port, process_request=self._refused, max_size=most_bytes, compression=None
            )
        except OSError as error:
            raise InputError("content.options", "port", f"cannot listen on port {port}: {error.strerror}") from None
        self.address = f"ws://{HOST}:{self._server.socket.getsockname()[1]}/?token={self._token}"
        begin("programs", self._server.serve_forever)
        log.info("waiting for a program to connect; `phasestack status` shows the address under `program`")

    def ask(self, views: Sequence[View], *, time_ns: int) -> int:
        """Request the pictures of a frame and return its number. Raises ContentFailure without a program."""
        view, now_s = views[0], time.monotonic()
        with self._changed:
            self._count += 1
            number, program = self._count, self._drawing
            self._frames = {n: frame for n, frame in self._frames.items() if now_s - frame.asked_s < GIVEN_UP_S}
            request = {"frame": number, "time_s": time_ns / NS_PER_S, "width": view.width_px, "height": view.height_px}
            message = json.dumps(request | {"eyes": [camera_of(one) for one in views]})
            if program is not None and len(self._frames) < IN_FLIGHT_MAX:
                self._frames[number] = _Frame(views, now_s)
            others = tuple(self._listening)
        for connection in (*others, *([program] if program is not None and number in self._frames else [])):
            with suppress(ConnectionClosed):
                connection.send(message)
        if program is None:
            why = f" ({self.problem})" if self.problem else ""
            raise ContentFailure(f"no program is connected{why}; the status shows its address under `program`")
        if number not in self._frames:
            raise ContentFailure(f"the program is late: {IN_FLIGHT_MAX} requests are unanswered")
        return number

    def answer(self, number: int, side: int) -> U8:
        """Wait for one picture of a frame, and return it. Raises ContentFailure."""
        with self._changed:
            frame = self._frames.get(number)
            if frame is not None:
                within_s = frame.asked_s + ANSWERED_S - time.monotonic()
                self._changed.wait_for(lambda: side in frame.pictures or number not in self._frames, within_s)
                if side in frame.pictures:
                    return frame.pictures[side]
        raise ContentFailure(self.problem or f"the program did not answer within {1e3 * ANSWERED_S:.0f} ms")

    def done(self, number: int) -> None:
        """Stop waiting for a frame. It counts as in flight until it is answered."""
        with self._changed:
            frame = self._frames.get(number)
            if frame is not None:
                frame.awaited = False
                if frame.complete:
                    del self._frames[number]

    def close(self) -> None:
        """Close the port and all connections."""
        begin("programs", self._server.shutdown)

    def _refused(self, connection: ServerConnection, request: Any) -> Any:
        token = parse_qs(urlsplit(request.path).query).get("token", [""])[0]
        if not hmac.compare_digest(token.encode(), self._token.encode()):
            return connection.respond(403, "the token in the address is wrong\n")
        return None

    def _connected(self, connection: ServerConnection) -> None:
        """Serve a connection on its thread. Its first message states whether it draws or listens."""
        why = "the program closed the connection"
        try:
            hello = json.loads(connection.recv(timeout=HELLO_S))
            if not isinstance(hello, dict):
                raise ValueError("the first message is not a JSON object")
            self._welcome(connection, hello)
            for message in connection:
                self._take(connection, message)
        except (ConnectionClosed, TimeoutError):
            pass
        except ValueError as error:
            why = one_line(str(error), most=100)
            connection.close(1007, why)
        finally:
            with self._changed:
                self._listening.discard(connection)
                if self._drawing is connection:
                    self._drawing, self.problem = None, why
                    self._frames.clear()
                    self._changed.notify_all()
                    log.warning("lost the drawing program: %s", why)

    def _welcome(self, connection: ServerConnection, hello: dict[str, Any]) -> None:
        with self._changed:
            if hello.get("listens"):
                self._listening.add(connection)
                return
            before, self._drawing = self._drawing, connection
            self._bottom_up, self.problem = hello.get("rows") == "bottom-up", ""
            self._frames.clear()
            self._changed.notify_all()
        log.info("drawing program connected: %s", one_line(str(hello.get("name", "unnamed")), most=80))
        if before is not None:
            before.close(1001, "another program has replaced it")

    def _take(self, connection: ServerConnection, message: str | bytes) -> None:
        """Accept one picture. Raises ValueError for any other message."""
        if not isinstance(message, bytes) or len(message) < HEAD.size:
            raise ValueError("the answer is not a picture")
        number, side = HEAD.unpack_from(message)
        with self._changed:
            frame = self._frames.get(number)
            if connection is not self._drawing or frame is None:
                return  # the frame was abandoned
            height, width = frame.views[0].height_px, frame.views[0].width_px
            if len(message) - HEAD.size != 4 * width * height:
                size = len(message) - HEAD.size
                raise ValueError(f"the answer has {size} bytes instead of {width}x{height} RGBA pixels")
            picture = np.frombuffer(message, np.uint8, offset=HEAD.size).reshape(height, width, 4)
            frame.pictures[side] = np.ascontiguousarray(picture[::-1]) if self._bottom_up else picture
            if frame.complete:
                self.frame_ms = 1e3 * (time.monotonic() - frame.asked_s)
                if not frame.awaited:
                    del self._frames[number]
            self._changed.notify_all()


class ProgramSource(ContentSource):
    """Source that shows pictures of the connected program, drawn for exactly the eyes solved for."""

    def __init__(self, programs: Programs, *, background: Any) -> None:
        self._programs = programs
        self.info = ContentInfo("program", moving=True, background=background)
        self._expected: tuple[int, list[View]] | None = None  # the requested frame and its views
        weakref.finalize(self, programs.close)

    @property
    def program(self) -> dict[str, Any]:
        return {"address": self._programs.address, "frame_ms": self._programs.frame_ms}

    @property
    def problem(self) -> str:
        return self._programs.problem

    def expect(self, views: Sequence[View], *, time_ns: int) -> None:
        if self._expected is not None:
            self._programs.done(self._expected[0])
            self._expected = None
        self._expected = self._programs.ask(views, time_ns=time_ns), list(views)

    def render(self, view: View, *, time_ns: int) -> U8:
        if self._expected is None or not any(_same(view, one) for one in self._expected[1]):
            self.expect([view], time_ns=time_ns)
        assert self._expected is not None
        return self._programs.answer(self._expected[0], view.side)

    def close(self) -> None:
        self._programs.close()


def _same(view: View, other: View) -> bool:
    matrices = view.pixels_from_stack, other.pixels_from_stack
    return view.side == other.side and np.array_equal(*matrices) and view.width_px == other.width_px
