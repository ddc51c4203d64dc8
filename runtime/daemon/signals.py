"""Signal handlers that set flags for the loop to poll."""

from __future__ import annotations

import math
import signal
import time
from types import FrameType
from typing import Any, Self

from runtime.support.background import STOPS_WITHIN_S, ends_by


class Signals:
    """Context manager, on the main thread, that sets flags on SIGTERM and SIGINT (stop) and SIGHUP
    (reload). If a stop has already been requested, SIGINT raises KeyboardInterrupt. The previous handlers are restored
    on exit.
    """

    def __init__(self) -> None:
        self.stop = ""  # the signal that requested a stop; empty if none has
        self._reload = False
        self._previous: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Self:
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            self._previous[number] = signal.signal(number, self._take)
        return self

    def __exit__(self, *exception: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        self._previous.clear()
        ends_by(math.inf)

    def take_reload(self) -> bool:
        """Return True if a reload signal has been received since the last call."""
        asked, self._reload = self._reload, False
        return asked

    def _take(self, number: int, frame: FrameType | None) -> None:
        if number == signal.SIGHUP:
            self._reload = True
            return
        if number == signal.SIGINT and self.stop:
            raise KeyboardInterrupt
        if not self.stop:
            ends_by(time.monotonic() + STOPS_WITHIN_S)
        self.stop = signal.Signals(number).name
