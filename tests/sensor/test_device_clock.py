"""Tests that the fastest of many deliveries relates device time to the host's clock."""

from __future__ import annotations

import numpy as np

from runtime.sensor.base import DeviceClock

MS = 1_000_000


def test_jitter_of_delivery_does_not_reach_the_capture_times() -> None:
    random, clock, errors = np.random.default_rng(0), DeviceClock(), []
    for k in range(600):
        device_ns = k * 16 * MS
        arrival_ns = 10**12 + device_ns + 3 * MS + round(random.exponential(4 * MS))
        errors.append(clock.host_ns(device_ns, arrival_ns=arrival_ns) - (10**12 + device_ns + 3 * MS))
    assert max(abs(e) for e in errors[100:]) < 1 * MS


def test_a_capture_is_never_after_its_arrival() -> None:
    random, clock, device_ns = np.random.default_rng(1), DeviceClock(), 0
    for k in range(2000):
        device_ns = max(0, device_ns + int(random.integers(-5 * MS, 40 * MS)))
        arrival_ns = k * 20 * MS + int(random.integers(0, 10 * MS))
        assert clock.host_ns(device_ns, arrival_ns=arrival_ns) <= arrival_ns


def test_drift_between_the_clocks_is_followed() -> None:
    clock = DeviceClock()
    for k in range(4000):  # two minutes, 100 parts per million too fast: 12 ms in the end
        device_ns = round(k * 33 * MS * (1 + 1e-4))
        error = clock.host_ns(device_ns, arrival_ns=k * 33 * MS) - k * 33 * MS
    assert abs(error) < 2 * MS
