"""Drivers by name. A driver's module, and so its SDK, is imported only when it is asked for."""

from __future__ import annotations

from collections.abc import Callable

from runtime.clock import Clock
from runtime.config import SensorSettings, validated
from runtime.errors import InputError, PhasestackError
from runtime.sensor.base import Sensor
from runtime.support.crash import written
from runtime.support.plausible import nearest
from runtime.support.plugins import is_plugin, plugin_class, strict


def _replay(settings: SensorSettings, clock: Clock, latency_ms: float) -> Sensor:
    from runtime.sensor.replay import ReplayDriver

    return ReplayDriver(settings.source, clock, loop=settings.loop, latency_ms=latency_ms)


def _device(name: str) -> Callable[[SensorSettings, Clock, float], Sensor]:
    """A driver whose class, `module:Class`, is imported when one is made."""

    def make(settings: SensorSettings, clock: Clock, latency_ms: float) -> Sensor:
        driver: Sensor = plugin_class(f"runtime.sensor.{name}", Sensor, field="sensor.driver")(settings, clock)
        return driver

    return make


_FACTORIES: dict[str, Callable[[SensorSettings, Clock, float], Sensor]] = {
    "replay": _replay,
    "fixed": _device("fixed:FixedDriver"),
    "openni2": _device("openni2:OpenNI2Driver"),
    "usb-eyes": _device("usb_eyes:UsbEyesDriver"),
    "usb-camera": _device("usb_camera:UsbCameraDriver"),
}


def driver_names() -> tuple[str, ...]:
    """The drivers that come with phasestack."""
    return tuple(_FACTORIES)


def open_sensor(settings: SensorSettings, clock: Clock, *, latency_ms: float = 0.0) -> Sensor:
    """The configured driver, not yet opened: one of ours, or a class of the user's own (`module:Class`).

    latency_ms: from capture to arrival, of what is only replayed.

    Raises InputError for a name that nobody knows or options that the class refuses, MissingPart for an SDK that is
    not installed.
    """
    name = settings.driver
    if is_plugin(name):
        return _plugin(name, settings, clock)
    if name not in _FACTORIES:
        known = f"{', '.join(_FACTORIES)}, or a class of yours: module:Class"
        raise InputError("sensor", "driver", f"unknown: {name!r}{nearest(name, driver_names())}; known: {known}")
    return _FACTORIES[name](settings, clock, latency_ms)


def _plugin(name: str, settings: SensorSettings, clock: Clock) -> Sensor:
    plugin = plugin_class(name, Sensor, field="sensor.driver")
    options = validated(strict(plugin.Options), settings.options, source="sensor.options")
    try:
        sensor: Sensor = plugin(options, clock=clock)
    except PhasestackError:
        raise
    except Exception as error:
        raise InputError(name, "", written(error)) from error
    return sensor
