"""Signals become flags that the loop reads at its own pace."""

from __future__ import annotations

import math
import signal
import time
from types import FrameType, TracebackType
from typing import Any, Self

from runtime.support.background import STOPS_WITHIN_S, ends_by


class Signals:
    """SIGTERM and SIGINT ask to stop, SIGHUP asks to reload. A second SIGINT interrupts whatever runs.

    A context manager, on the main thread: the handlers before it are back afterwards.
    """

    def __init__(self) -> None:
        self.stop = ""  # which signal asked to stop
        self._reload = False
        self._previous: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Self:
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            self._previous[number] = signal.signal(number, self._take)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        self._previous.clear()
        ends_by(math.inf)

    def take_reload(self) -> bool:
        """True once for each time (or burst) that a reload was asked for."""
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
