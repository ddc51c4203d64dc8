"""What a stream sends, taken in as it comes: who decodes slowly knows that it is behind, and leaves out what is old."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

BEHIND = 8  # packets that wait, from which on all before the newest key picture are left out
MOST_BYTES = 64 << 20  # that wait; the oldest make way


class Arrivals:
    """Packets of one stream. A thread of its own reads; one other thread takes and, in the end, closes."""

    def __init__(self, container: Any, stream: Any, *, arrived: Callable[[], None]) -> None:
        """container: an open `av` container, which nobody else reads; arrived: told of each packet, by the thread."""
        self._container, self._stream, self._arrived = container, stream, arrived
        self._packets: deque[Any] = deque()
        self._bytes = 0
        self._broken = False  # something was left out: what follows cannot be decoded on from what was before
        self._ended, self._closing = False, False
        self._problem: Exception | None = None
        self._news = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="stream packets", daemon=True)
        self._thread.start()

    def batches(self) -> Iterator[tuple[list[Any], bool]]:
        """All packets that wait, each time that some do, and whether some were left out before them.

        Ends with the stream. Raises what reading it raised.
        """
        while True:
            with self._news:
                self._news.wait_for(lambda: self._packets or self._ended)
                packets, broken = list(self._packets), self._broken
                self._packets.clear()
                self._bytes, self._broken = 0, False
            if not packets:
                if self._problem is not None:
                    raise self._problem
                return
            if len(packets) >= BEHIND:
                newest_key = max((place for place, packet in enumerate(packets) if packet.is_keyframe), default=0)
                packets, broken = packets[newest_key:], broken or newest_key > 0
            yield packets, broken

    def close(self) -> None:
        """No more is read. Waits for the read that is under way, which has a time limit of its own."""
        self._closing = True
        self._thread.join()

    def _run(self) -> None:
        try:
            for packet in self._container.demux(self._stream):
                if self._closing:
                    break
                if packet.size:  # the last one, empty, says that it is the last one
                    self._arrived()
                self._put(packet)
        except Exception as error:  # told to who takes
            self._problem = error
        with self._news:
            self._ended = True
            self._news.notify()

    def _put(self, packet: Any) -> None:
        with self._news:
            self._packets.append(packet)
            self._bytes += packet.size
            while self._bytes > MOST_BYTES and len(self._packets) > 1:
                self._bytes -= self._packets.popleft().size
                self._broken = True
            self._news.notify()
