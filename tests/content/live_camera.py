"""A camera that streams what time it is: each picture carries its number, so that who sees it knows how old it is.

The number stands in a row of black and white blocks, and its complement in the row below, for either eye.
"""

from __future__ import annotations

import io
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction

import av
import numpy as np

from tests.content.streams import Served

RATE = 25  # pictures a second
BITS = 14  # some eleven minutes of numbers
WIDTH, HEIGHT = 416, 234  # of one eye's picture
LEVELS = (30, 225)
LEFT, RIGHT = 0.14, 0.86  # of the picture's width, between which the blocks are: what is at its edge an eye may not see
LEAST_CONTRAST = 40  # between a block and its complement, of 255, where a number is to be believed


def numbered_picture(number: int, *, side: int) -> np.ndarray:
    """(HEIGHT, WIDTH, 3) one eye's picture: rows of blocks on a ground of the eye's colour, and a bar that moves."""
    picture = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    picture[:] = (150, 90, 60) if side == 0 else (60, 100, 150)
    at = number * 4 % WIDTH
    picture[:, at : at + 12] = (230, 200, 80)
    high = HEIGHT // 5
    for bit in range(BITS):
        on = number >> bit & 1
        columns = _columns(bit, WIDTH, 0.0, 1.0)
        picture[high : 2 * high, columns] = LEVELS[on]
        picture[3 * high : 4 * high, columns] = LEVELS[1 - on]
    return picture


def number_in(seen: np.ndarray) -> int | None:
    """The number in an eye's view of a picture (h, w, 3); None where a block is not told from its complement."""
    height, width = seen.shape[:2]
    grey = seen.astype(np.float64).mean(2)
    number = 0
    for bit in range(BITS):
        columns = _columns(bit, width, 0.3, 0.7)
        first, second = (
            grey[round((row + 0.25) * height / 5) : round((row + 0.75) * height / 5), columns].mean() for row in (1, 3)
        )
        if abs(first - second) < LEAST_CONTRAST:
            return None
        number |= int(first > second) << bit
    return number


def _columns(bit: int, width: int, begin: float, end: float) -> slice:
    """Those of a bit's block, or of a part of it."""
    places = [LEFT + (RIGHT - LEFT) * (bit + share) / BITS for share in (begin, end)]
    return slice(*(round(place * width) for place in places))


class LiveCamera(Served):
    """Sends MPEG-TS, a picture each 1/RATE s, numbered by its own clock; may stall and hang up."""

    def __init__(self) -> None:
        self.stalls = threading.Event()
        self.sent_ns: dict[int, int] = {}  # by number: when it was handed to the network, ns since 1970
        self._begun_s = time.monotonic()
        super().__init__()

    def _send(self, client: socket.socket) -> None:
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        held = io.BytesIO()
        with av.open(held, "w", format="mpegts", options={"flush_packets": "1"}) as container:
            stream = container.add_stream("mpeg2video", rate=RATE)
            stream.width, stream.height, stream.pix_fmt = 2 * WIDTH, HEIGHT, "yuv420p"
            stream.bit_rate, stream.gop_size = 3_000_000, 10
            stream.options = {"flags": "+low_delay"}
            first, before = None, -1
            while not self._closing.wait(0.004) and not self.hang_up.is_set():
                number = int((time.monotonic() - self._begun_s) * RATE)
                if number == before or self.stalls.is_set():
                    continue
                first, before = number if first is None else first, number
                pair = np.hstack([numbered_picture(number, side=side) for side in (0, 1)])
                frame = av.VideoFrame.from_ndarray(pair, format="rgb24")
                frame.pts, frame.time_base = number - first, Fraction(1, RATE)
                for packet in stream.encode(frame):
                    container.mux(packet)
                self.sent_ns[number] = time.time_ns()
                client.sendall(held.getvalue())
                held.seek(0)
                held.truncate()


@contextmanager
def live_camera() -> Iterator[LiveCamera]:
    camera = LiveCamera()
    try:
        yield camera
    finally:
        camera.close()
