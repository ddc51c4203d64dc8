"""Drivers by name. A driver's module, and so its SDK, is imported only when it is asked for."""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import entry_points

from runtime.clock import Clock
from runtime.config import LimitSettings, SensorSettings
from runtime.errors import InputError
from runtime.sensor.base import SensorDriver

DriverFactory = Callable[[SensorSettings, Clock, float], SensorDriver]
ENTRY_POINTS = "phasestack.sensors"


def _replay(
    settings: SensorSettings, clock: Clock, latency_ms: float, limits: LimitSettings | None = None
) -> SensorDriver:
    from runtime.sensor.replay import ReplayDriver

    s = settings
    return ReplayDriver(s.source, clock, loop=s.loop, start_s=s.start_s, latency_ms=latency_ms, limits=limits)


def _fixed(settings: SensorSettings, clock: Clock, latency_ms: float) -> SensorDriver:
    from runtime.sensor.fixed import FixedDriver

    return FixedDriver(settings, clock)


def _openni2(settings: SensorSettings, clock: Clock, latency_ms: float) -> SensorDriver:
    from runtime.sensor.openni2 import OpenNI2Driver

    return OpenNI2Driver(settings, clock)


def _usb_eyes(settings: SensorSettings, clock: Clock, latency_ms: float) -> SensorDriver:
    from runtime.sensor.usb_eyes import UsbEyesDriver

    return UsbEyesDriver(settings, clock)


_FACTORIES: dict[str, DriverFactory] = {
    "replay": _replay,
    "fixed": _fixed,
    "openni2": _openni2,
    "usb-eyes": _usb_eyes,
}


def register_driver(name: str, factory: DriverFactory) -> None:
    """Add a driver, or replace one."""
    _FACTORIES[name] = factory


def driver_names() -> tuple[str, ...]:
    """All names that `open_sensor` knows: ours, registered ones, and those of installed packages."""
    return (*_FACTORIES, *(point.name for point in entry_points(group=ENTRY_POINTS) if point.name not in _FACTORIES))


def open_sensor(
    settings: SensorSettings, clock: Clock, *, latency_ms: float = 0.0, limits: LimitSettings | None = None
) -> SensorDriver:
    """The configured driver, not yet opened.

    latency_ms: from capture to arrival, of what is only replayed; limits: of a recording's bytes, None: the defaults.

    Raises InputError for a name that nobody registered, MissingPart for an SDK that is not installed.
    """
    factory = _FACTORIES.get(settings.driver)
    if factory is None:
        for point in entry_points(group=ENTRY_POINTS, name=settings.driver):
            factory = point.load()
    if factory is None:
        raise InputError("sensor", "driver", f"unknown: {settings.driver!r}; known: {', '.join(driver_names())}")
    if factory is _replay:
        return _replay(settings, clock, latency_ms, limits)
    return factory(settings, clock, latency_ms)
