"""The driver contract: open, capabilities, read the newest, close."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from types import TracebackType
from typing import Self

from runtime.records import SensorFrame


@dataclass(frozen=True, slots=True)
class Capabilities:
    """What a sensor delivers."""

    colour: bool = False
    depth: bool = False
    infrared: bool = False
    eye_points: bool = False  # it finds the eyes itself: no detector is needed


class SensorDriver(ABC):
    """One depth sensor, eye tracker or recording.

    A constructor only keeps its settings; `open` acquires and cleans up after itself when it fails.
    One thread uses a driver; that thread may be abandoned when an SDK hangs.
    """

    name: str
    capabilities: Capabilities
    serial: str = ""  # known after `open`; empty where the device has none

    @abstractmethod
    def open(self) -> None:
        """Acquire the device. Raises SensorLost (not there, retry), FatalError (never will be)."""

    @abstractmethod
    def read_newest(self, timeout_s: float) -> SensorFrame:
        """The newest frame not yet read, with its capture time; waits for one, at most `timeout_s`.

        Raises SensorTimeout (nothing new), SensorLost (close and reopen), EndOfRecording.
        """

    @abstractmethod
    def close(self) -> None:
        """Release everything. May be called twice, and after a failed `open`; never raises."""

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
