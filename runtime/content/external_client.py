"""A small client for programs that draw phasestack's pictures: standard library and numpy only.

    with ExternalClient("/run/phasestack/content.sock") as display:
        while (request := display.wait()) is not None:
            display.send(request, left_rgba, right_rgba)

It may be copied out of this project; docs/external-content.md is the protocol.
"""

from __future__ import annotations

import json
import mmap
import os
import socket
import struct
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

SLOT_HEADER = struct.Struct("<QQQ")  # begin, end, request
LONGEST_LINE = 65536


@dataclass(frozen=True, slots=True)
class Request:
    """What to draw: two eyes and the projections of their pictures."""

    number: int
    time_ns: int  # the daemon's clock
    eyes_m: NDArray[np.float64]  # (2, 3) left, right; frame `stack`
    pixels_from_stack: NDArray[np.float64]  # (2, 3, 4)


class ExternalClient:
    """Connects to the daemon, waits for eye poses, hands over pictures."""

    def __init__(self, path: str, timeout_s: float = 10.0) -> None:
        """Raises OSError (no daemon there) or ValueError (it speaks otherwise)."""
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._socket.settimeout(timeout_s)
        self._socket.connect(path)
        data, descriptors, _, _ = socket.recv_fds(self._socket, LONGEST_LINE, 1)
        line, _, self._pending = data.partition(b"\n")
        hello = json.loads(line or b"{}")
        if hello.get("phasestack_content") != 1 or len(descriptors) != 1:
            raise ValueError(f"no phasestack content socket, or busy: {line[:200]!r}")
        self.width_px: int = hello["width_px"]
        self.height_px: int = hello["height_px"]
        self._slots: int = hello["slots"]
        self._slot_bytes: int = hello["slot_bytes"]
        self._first: int = hello["first_slot"]
        self._pixels: int = hello["pixels"]
        self._memory = mmap.mmap(descriptors[0], hello["bytes"])
        os.close(descriptors[0])
        self._sequence = 0

    def wait(self) -> Request | None:
        """The newest request; None when the daemon is gone. Raises TimeoutError."""
        while b"\n" not in self._pending:
            data = self._socket.recv(LONGEST_LINE)
            if not data:
                return None
            self._pending += data
        *lines, self._pending = self._pending.split(b"\n")
        table: dict[str, Any] = json.loads(lines[-1])
        return Request(
            table["request"], table["time_ns"], np.array(table["eyes_m"]), np.array(table["pixels_from_stack"])
        )

    def send(self, request: Request, left: NDArray[np.uint8], right: NDArray[np.uint8]) -> None:
        """Hand over both pictures, (height, width, 4) RGBA each, alpha 0 where only the background shows.

        The slot not written last is filled; its number stands before and after the pictures, so that the daemon
        can tell a whole picture from one that is being written.
        """
        shape = (self.height_px, self.width_px, 4)
        if left.shape != shape or right.shape != shape:
            raise ValueError(f"pictures must be {shape}, not {left.shape} and {right.shape}")
        self._sequence += 1
        start = self._first + (self._sequence % self._slots) * self._slot_bytes
        self._memory[start : start + 8] = struct.pack("<Q", self._sequence)
        self._memory[start + 16 : start + 24] = struct.pack("<Q", request.number)
        pixels = start + self._pixels
        size = left.nbytes
        self._memory[pixels : pixels + size] = np.ascontiguousarray(left, np.uint8).tobytes()
        self._memory[pixels + size : pixels + 2 * size] = np.ascontiguousarray(right, np.uint8).tobytes()
        self._memory[start + 8 : start + 16] = struct.pack("<Q", self._sequence)

    def close(self) -> None:
        self._socket.close()
        self._memory.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
