"""A server that sends a stream, as well or badly as it is told."""

from __future__ import annotations

import io
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from fractions import Fraction

import av
import numpy as np

RATE = 25


def stereo_picture(number: int, width: int = 160, height: int = 48) -> np.ndarray:
    """Left half red, right half blue, both with a green level that tells the number."""
    picture = np.zeros((height, width, 3), np.uint8)
    picture[:, : width // 2, 0] = 200
    picture[:, width // 2 :, 2] = 200
    picture[..., 1] = 20 + 4 * (number % 40)
    return picture


def transport_stream(pictures: int, *, first: int = 0, size: tuple[int, int] = (160, 48)) -> bytes:
    """Stereo pictures as MPEG-TS bytes, as cameras and encoders send them."""
    held = io.BytesIO()
    with av.open(held, "w", format="mpegts") as container:
        stream = container.add_stream("mpeg2video", rate=RATE)
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        stream.bit_rate = 4_000_000
        stream.gop_size = 5
        for number in range(pictures):
            frame = av.VideoFrame.from_ndarray(stereo_picture(first + number, *size), format="rgb24")
            frame.pts, frame.time_base = number, Fraction(1, RATE)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return held.getvalue()


class StreamServer:
    """Sends bytes to whoever connects, one at a time, at a pace; holds or hangs up when it is told."""

    def __init__(self, data: bytes) -> None:
        self.data, self.connections = data, 0
        self.hold, self.hang_up, self._closing = (threading.Event() for _ in range(3))
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.url = f"tcp://127.0.0.1:{self._listening.getsockname()[1]}"
        threading.Thread(target=self._run, name="served", daemon=True).start()

    def close(self) -> None:
        self._closing.set()
        self._listening.close()

    def _run(self) -> None:
        while not self._closing.is_set():
            try:
                client, _ = self._listening.accept()
            except OSError:
                return
            self.connections += 1
            self.hang_up.clear()
            with client, suppress(OSError):  # who was served has gone
                self._send(client)

    def _send(self, client: socket.socket) -> None:
        at, step = 0, 188 * 16
        while at < len(self.data) and not self._closing.is_set() and not self.hang_up.is_set():
            if not self.hold.is_set():
                client.sendall(self.data[at : at + step])
                at += step
            self._closing.wait(0.01)


@contextmanager
def served(data: bytes) -> Iterator[StreamServer]:
    server = StreamServer(data)
    try:
        yield server
    finally:
        server.close()
