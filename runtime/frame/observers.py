"""Several observers of one run, told one after the other."""

from __future__ import annotations

from runtime.frame.presenter import Observer, Refresh
from runtime.records import SensorFrame


class Observers:
    """Tells each of them everything, in their order."""

    def __init__(self, *observers: Observer) -> None:
        self._observers = observers

    def sampled(self, sample: SensorFrame) -> None:
        for observer in self._observers:
            observer.sampled(sample)

    def refreshed(self, refresh: Refresh) -> None:
        for observer in self._observers:
            observer.refreshed(refresh)
