"""Sensor driver registry. A driver's module and SDK are imported only when the driver is used."""

from __future__ import annotations

from runtime.clock import Clock
from runtime.config import SensorSettings, validated
from runtime.errors import InputError, PhasestackError
from runtime.sensor.base import Sensor
from runtime.support.crash import written
from runtime.support.plausible import nearest
from runtime.support.plugins import is_plugin, plugin_class, strict

DRIVERS = {  # included in phasestack
    "replay": "replay:ReplayDriver",
    "fixed": "fixed:FixedDriver",
    "openni2": "openni2:OpenNI2Driver",
    "realsense": "realsense:RealSenseDriver",
    "usb-camera": "usb_camera:UsbCameraDriver",
}


def open_sensor(settings: SensorSettings, clock: Clock, *, latency_ms: float = 0.0) -> Sensor:
    """Create the configured driver, of `DRIVERS` or `module:Class`, without opening the device.
    `latency_ms` is replayed samples' delay. Raises InputError for the name or the options, or MissingPart.
    """
    name = settings.driver
    if is_plugin(name):
        return _plugin(name, settings, clock)
    if name not in DRIVERS:
        known = f"{', '.join(DRIVERS)} or your own class as module:Class"
        raise InputError("sensor", "driver", f"unknown driver {name!r}{nearest(name, DRIVERS)} (drivers: {known})")
    driver = plugin_class(f"runtime.sensor.{DRIVERS[name]}", Sensor, field="sensor.driver")
    replayed = {"loop": settings.loop, "latency_ms": latency_ms}
    sensor: Sensor = driver(settings.source, clock, **replayed) if name == "replay" else driver(settings, clock)
    return sensor


def _plugin(name: str, settings: SensorSettings, clock: Clock) -> Sensor:
    plugin = plugin_class(name, Sensor, field="sensor.driver")
    options = validated(strict(plugin.Options), settings.options, source="sensor.options")
    try:
        sensor: Sensor = plugin(options, clock=clock)
    except PhasestackError:
        raise
    except (Exception, SystemExit) as error:
        raise InputError(name, "", written(error)) from error
    return sensor
