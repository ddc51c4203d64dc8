"""Drivers are found by name, and their SDKs are not imported before they are asked for."""

from __future__ import annotations

import subprocess
import sys

import pytest

from runtime.clock import SimulatedClock
from runtime.config import SensorSettings
from runtime.errors import InputError
from runtime.sensor.base import SteppedSensor
from runtime.sensor.registry import open_sensor

EYES = ((0.6, -0.03, 0.0), (0.6, 0.03, 0.0))


def test_no_sdk_is_imported_by_looking_drivers_up() -> None:
    code = (
        "import sys; from runtime.sensor.registry import DRIVERS, open_sensor; from runtime.config import *;"
        "from runtime.clock import *; open_sensor(SensorSettings(driver='openni2'), MonotonicClock());"
        "bad = [m for m in ('openni', 'usb', 'mcap', 'cv2') if m in sys.modules]; sys.exit(str(bad) if bad else 0)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_fixed_eyes_stand_where_the_configuration_says_or_it_is_refused() -> None:
    with pytest.raises(InputError, match="fixed_eyes_m"):
        open_sensor(SensorSettings(driver="fixed"), SimulatedClock())
    clock = SimulatedClock(50)
    driver = open_sensor(SensorSettings(driver="fixed", fixed_eyes_m=EYES), clock)
    assert isinstance(driver, SteppedSensor) and driver.capabilities.in_stack_frame
    with driver:
        frames = [driver.next_sample() for _ in range(3)]
        assert frames[2].eyes.eyes_m.tolist() == [list(e) for e in EYES]
        assert [f.sequence for f in frames] == [1, 2, 3] and frames[0].capture_ns == 50
        clock.advance_ns(10**9)
        late = driver.read_newest(0.1)
        assert late.sequence == 31 and driver.skipped == 27 and late.capture_ns <= clock.now_ns()
