"""Client for the scene `program`. It takes requests and sends the application's pictures.

docs/programs.md describes the protocol. A separate thread serves the connection. Drawing stays on the caller's thread.
"""

from __future__ import annotations

import json
import logging
import struct
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from runtime.daemon.client import NotRunning, ask, sockets
from runtime.errors import InputError, TransientError
from runtime.records import F32, F64, U8
from runtime.support.background import begin
from runtime.support.extras import missing_extra

log = logging.getLogger("phasestack.drawing")

HEAD = struct.Struct("<II")  # frame number and eye (0 left, 1 right)
AGAIN_S = 1.0  # pause before the next attempt to connect
SCENE_S = 20.0  # time limit for the scene `program` to start


@dataclass(frozen=True, slots=True)
class EyeRequest:
    """One eye's picture to draw, in frame `stack` (metres)."""

    side: int  # 0 left, 1 right
    eye_m: F64  # (3,)
    view: F64  # (4, 4) OpenGL view matrix
    projection: F64  # (4, 4) OpenGL projection matrix, off-axis
    at: int | None  # first byte of the picture in shared memory, or None if the picture is sent


@dataclass(frozen=True, slots=True)
class DrawingRequest:
    """A frame to draw."""

    number: int
    time_s: float  # on the run's clock
    width_px: int
    height_px: int
    display_m: tuple[float, float]  # width and height of the panels
    eyes: tuple[EyeRequest, ...]  # both eyes, or one


def request_of(message: Mapping[str, Any]) -> DrawingRequest:
    """Return the request in a message of the protocol."""
    eyes = tuple(
        EyeRequest(
            side=("left", "right").index(eye["eye"]),
            eye_m=np.array(eye["eye_m"]),
            view=np.reshape(eye["view"], (4, 4)).T,
            projection=np.reshape(eye["projection"], (4, 4)).T,
            at=eye.get("at"),
        )
        for eye in message["eyes"]
    )
    width_m, height_m = message["display_m"]
    return DrawingRequest(
        message["frame"], message["time_s"], message["width"], message["height"], (width_m, height_m), eyes
    )


def found_address() -> str:
    """Return the address for drawing programs of a running service, `run` or `try`, after selecting scene
    `program` there. Raises TransientError if nothing is running, or the scene does not start.
    """
    until_s, asked = time.monotonic() + SCENE_S, False
    while time.monotonic() < until_s:
        try:
            status = ask(sockets(None), {"command": "status"})
        except NotRunning:
            raise TransientError("phasestack is not running; start `phasestack try --scene program`") from None
        program = status.get("program")
        if program:
            return str(program["address"])
        if not asked and "scene" in status:
            ask(sockets(None), {"command": "scene", "value": "program"}, timeout_s=SCENE_S)
            asked = True
        time.sleep(0.1)
    raise TransientError("phasestack does not show the scene `program`; see `phasestack status`")


class DrawingClient:
    """Connection of an application that draws, restored by itself. No method waits."""

    def __init__(self, address: str, *, name: str) -> None:
        """Start connecting to an address, or "" to look for it. Raises InputError without websockets."""
        try:
            from websockets.sync import client
        except ImportError as error:
            raise missing_extra(error) or error from None
        self._library, self._address, self._name = client, address, name
        self._socket: Any = None
        self._memory: U8 | None = None
        self._lock = threading.Lock()
        self._newest: DrawingRequest | None = None
        self._ends = threading.Event()
        self.problem = "not connected yet"  # why there is no connection; empty: there is one
        begin("phasestack", self._run)

    def newest(self) -> DrawingRequest | None:
        """Return the newest request once, or None if it is not new."""
        with self._lock:
            request, self._newest = self._newest, None
        return request

    def answer(self, request: DrawingRequest, eye: EyeRequest, pixels: U8, depth: F32) -> None:
        """Send an eye's RGBA picture and depth buffer (0-1, 1: background), bottom row first."""
        head, parts = HEAD.pack(request.number, eye.side), (pixels, depth.astype("<f4", copy=False))
        memory, socket = self._memory, self._socket
        if socket is None:
            return
        if memory is not None and eye.at is not None:
            at = eye.at
            for part in parts:
                memory[at : at + part.nbytes] = np.ascontiguousarray(part).reshape(-1).view(np.uint8)
                at += part.nbytes
            message = head
        else:
            message = head + b"".join(part.tobytes() for part in parts)
        with suppress(Exception):  # the connection was lost; the thread sees it and connects again
            socket.send(message)

    def close(self) -> None:
        """End the connection."""
        self._ends.set()
        if self._socket is not None:
            with suppress(Exception):
                self._socket.close()

    def _run(self) -> None:
        while not self._ends.is_set():
            try:
                address = self._address or found_address()
                with self._library.connect(address, max_size=None, compression=None) as socket:
                    hello = {"name": self._name, "rows": "bottom-up", "depth": "float32", "memory": True}
                    socket.send(json.dumps(hello))
                    self._socket, self.problem = socket, ""
                    for message in socket:
                        self._take(json.loads(message))
                    problem = socket.close_reason or "phasestack closed the connection"
            except Exception as error:  # of any kind: the next attempt may succeed
                reason = getattr(getattr(error, "rcvd", None), "reason", "")
                problem = reason or str(error) or type(error).__name__
            if problem != self.problem and not self._ends.is_set():
                log.warning("%s", problem)
            self.problem = problem
            self._socket = self._memory = None
            self._ends.wait(AGAIN_S)

    def _take(self, message: dict[str, Any]) -> None:
        if "memory" in message:
            try:
                self._memory = np.memmap(message["memory"]["path"], np.uint8, "r+")
            except OSError:  # of another user; pictures are sent instead
                self._memory = None
            return
        request = request_of(message)
        with self._lock:
            self._newest = request


def checked_budget(comfort_deg: float) -> float:
    """Return the comfort budget in degrees. Raises InputError if it is not usable."""
    if not 0.05 <= comfort_deg <= 10:
        raise InputError("attach", "comfort_deg", "must be from 0.05 to 10 degrees")
    return float(comfort_deg)
