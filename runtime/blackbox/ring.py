"""The newest messages, as long and as large as they may be."""

from __future__ import annotations

from collections import deque

from runtime.blackbox.messages import Message
from runtime.blackbox.schemas import STATE

OVERHEAD_BYTES = 200  # of a message besides its data


class Ring:
    """Holds messages; the oldest make way. One thread uses it."""

    def __init__(self, *, most_s: float, most_bytes: int) -> None:
        self._most_ns, self._most_bytes = round(most_s * 1e9), most_bytes
        self._messages: deque[tuple[int, Message]] = deque()  # and when, by the run's clock
        self._state: Message | None = None  # the newest that made way: it holds at the oldest message
        self.bytes_held = 0

    def add(self, message: Message, *, at_ns: int) -> None:
        """One more, at a time of the run's clock: the wall's may be set while it runs."""
        self._messages.append((at_ns, message))
        self.bytes_held += len(message.data) + OVERHEAD_BYTES
        while self._messages and (self.bytes_held > self._most_bytes or at_ns - self._messages[0][0] > self._most_ns):
            gone = self._messages.popleft()[1]
            self.bytes_held -= len(gone.data) + OVERHEAD_BYTES
            if gone.topic == STATE:
                self._state = gone

    def held(self) -> list[Message]:
        """All of them, the oldest first, behind the state that held then."""
        return ([self._state] if self._state is not None else []) + [message for _, message in self._messages]

    @property
    def seconds(self) -> float:
        """From the oldest to the newest."""
        if not self._messages:
            return 0.0
        return max(0.0, (self._messages[-1][0] - self._messages[0][0]) / 1e9)
