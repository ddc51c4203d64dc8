"""Show pictures drawn on request by another program, such as a renderer, a game or a web page.

docs/programs.md describes the protocol. If an answer is late or missing, the last pictures stay on the display.
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
from runtime.content.camera import clip_from_stack
from runtime.content.placing import SceneFile
from runtime.errors import ContentFailure, InputError, one_line
from runtime.records import U8
from runtime.support.background import begin

log = logging.getLogger("phasestack.content")

HOST = "127.0.0.1"
ANSWERED_S = 0.4  # time limit for both of a frame's pictures
GIVEN_UP_S = 2.0  # an unanswered frame is abandoned after this time
IN_FLIGHT_MAX = 2  # largest number of frames requested but not yet answered
HELLO_S = 5.0  # time limit for a program's greeting
NEAR_M, FAR_M = 0.05, 100.0
HEAD = struct.Struct("<II")  # an answer's header: frame number and side (0 left, 1 right)
SIDES = ("left", "right")


class ProgramOptions(Section):
    """Options in [content.options] for the scene `program`."""

    port: int = Field(0, ge=0, le=65535, description="TCP port to listen on (0 for any free port)")


def prepare(file: SceneFile) -> Callable[[Any], ContentSource]:
    """Start listening for drawing programs, and return a function that creates the source.

    Raises InputError if the options are invalid or the port cannot be opened.
    """
    options = validated(ProgramOptions, file.settings.options, source="content.options")
    size_px = file.stack.width_px * file.stack.height_px
    source = ProgramSource(Programs(options.port, most_bytes=8 * size_px + HEAD.size), background=file.background)
    return lambda context: source


def camera_of(view: View) -> dict[str, Any]:
    """Describe a view, in the form sent to programs.

    The description contains the eye's side and position, and the view and projection matrices for OpenGL as
    column-major lists. Lengths are in metres, and depth is in [-1, 1].
    """
    pixels = view.pixels_from_stack
    forward = pixels[2, :3] / np.linalg.norm(pixels[2, :3])
    right, down = (row[:3] - (row[:3] @ forward) * forward for row in pixels[:2])
    camera = np.eye(4)
    camera[:3, :3] = [right / np.linalg.norm(right), -down / np.linalg.norm(down), -forward]
    camera[:3, 3] = -camera[:3, :3] @ view.eye_m
    clip = clip_from_stack(view, near_m=NEAR_M, far_m=FAR_M)
    clip[1] *= -1  # programs draw with +y up
    matrices = {"view": camera, "projection": clip @ np.linalg.inv(camera)}
    return {"eye": SIDES[view.side], "eye_m": view.eye_m.tolist()} | {
        k: m.T.ravel().tolist() for k, m in matrices.items()
    }


@dataclass(slots=True)
class _Frame:
    """A frame requested from a program, with the pictures received so far."""

    views: Sequence[View]
    asked_s: float  # request time on the monotonic clock
    pictures: dict[int, U8] = field(default_factory=dict)  # received pictures, keyed by side
    awaited: bool = True  # True if `answer` may still be called for the frame

    @property
    def complete(self) -> bool:
        return len(self.pictures) == len(self.views)


class Programs:
    """Server that drawing programs connect to in order to receive requests and send pictures.

    The program that connected last does the drawing. Programs that only listen receive the same requests. All methods
    are thread-safe.
    """

    def __init__(self, port: int, *, most_bytes: int) -> None:
        """Listen on a port.

        Args:
            port: TCP port, or 0 for any free port.
            most_bytes: Largest message size to accept.

        Raises:
            InputError: The port cannot be opened.
        """
        self._token = secrets.token_urlsafe(24)
        self._changed = threading.Condition()
        self._drawing: ServerConnection | None = None  # connection to the latest drawing program
        self._listening: set[ServerConnection] = set()
        self._frames: dict[int, _Frame] = {}  # requested frames, keyed by number
        self._count, self._bottom_up = 0, False
        self.problem = ""
        self.frame_ms: float | None = None  # time from a recent request to the last picture in the answer
        try:
            self._server = serve(
                self._connected, HOST, port, process_request=self._refused, max_size=most_bytes, compression=None
            )
        except OSError as error:
            raise InputError("content.options", "port", f"cannot listen on port {port}: {error.strerror}") from None
        self.address = f"ws://{HOST}:{self._server.socket.getsockname()[1]}/?token={self._token}"
        begin("programs", self._server.serve_forever)
        log.info(
            "waiting for a program to connect; `phasestack status` shows the address to connect to under `program`"
        )

    def ask(self, views: Sequence[View], *, time_ns: int) -> int:
        """Request a frame's pictures, and return the frame's number.

        Args:
            views: Views to draw, all of the same size.
            time_ns: Time on the run's clock.

        Raises:
            ContentFailure: No program is connected, or too many requests are unanswered.
        """
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
            raise ContentFailure(
                f"no program is connected{why}; `phasestack status` shows the address to connect to under `program`"
            )
        if number not in self._frames:
            raise ContentFailure(f"the program is late: {IN_FLIGHT_MAX} requests are unanswered")
        return number

    def answer(self, number: int, side: int) -> U8:
        """Wait for one of a frame's pictures, and return it.

        Raises ContentFailure if the picture does not arrive in time or the program disconnects.
        """
        with self._changed:
            frame = self._frames.get(number)
            if frame is not None:
                within_s = frame.asked_s + ANSWERED_S - time.monotonic()
                self._changed.wait_for(lambda: side in frame.pictures or number not in self._frames, within_s)
                if side in frame.pictures:
                    return frame.pictures[side]
        raise ContentFailure(self.problem or f"the program did not answer within {1e3 * ANSWERED_S:.0f} ms")

    def done(self, number: int) -> None:
        """Declare that no more of a frame's pictures are needed.

        The frame still counts as in flight until it is answered or abandoned.
        """
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
        """Serve a connection on the connection's thread.

        A program's first message states whether it draws or only listens.
        """
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
        """Store a picture from a program. Raises ValueError if the message has the wrong type or size."""
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
                raise ValueError(f"the answer has {size} bytes, which is not {width}x{height} RGBA pixels")
            picture = np.frombuffer(message, np.uint8, offset=HEAD.size).reshape(height, width, 4)
            frame.pictures[side] = np.ascontiguousarray(picture[::-1]) if self._bottom_up else picture
            if frame.complete:
                self.frame_ms = 1e3 * (time.monotonic() - frame.asked_s)
                if not frame.awaited:
                    del self._frames[number]
            self._changed.notify_all()


class ProgramSource(ContentSource):
    """Source that shows pictures drawn by a connected program for the requested eye positions."""

    def __init__(self, programs: Programs, *, background: Any) -> None:
        self._programs = programs
        self.info = ContentInfo("program", moving=True, background=background)
        self._expected: tuple[int, list[View]] | None = None  # number and views of the requested frame
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
