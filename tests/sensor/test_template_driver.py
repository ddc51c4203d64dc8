"""The template driver of docs/sensors.md works as it stands there."""

from __future__ import annotations

import json
import re
import socket
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from runtime.clock import MonotonicClock
from runtime.config import SensorSettings
from runtime.errors import InputError, SensorLost, SensorTimeout
from runtime.sensor.registry import open_sensor

DOCS = Path(__file__).parents[2] / "docs" / "sensors.md"
(CODE,) = re.findall(r"```python\n(.*?)```", DOCS.read_text(), re.DOTALL)


@pytest.fixture(scope="module", autouse=True)
def registered() -> None:
    exec(compile(CODE, str(DOCS), "exec"), {"__name__": "template"})


@pytest.fixture
def port() -> Any:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


def send(port: Any, *numbers: Any) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for n in numbers:
            text = json.dumps({"n": n, "t_ns": n * 10**7, "left": [0.03, 0, 0.6], "right": [-0.03, 0, 0.6]})
            sender.sendto(text.encode(), ("127.0.0.1", port))


def test_it_is_under_a_hundred_lines() -> None:
    assert len(CODE.splitlines()) < 100


def test_it_delivers_the_newest_and_counts_the_rest(port: Any) -> None:
    with open_sensor(SensorSettings(driver="udp-eyes", source=str(port)), MonotonicClock()) as driver:
        with pytest.raises(SensorTimeout):
            driver.read_newest(0.01)
        send(port, 1, 2, 5)
        frame = driver.read_newest(0.5)
        assert (frame.sequence, driver.overtaken) == (5, 2)
        np.testing.assert_allclose(frame.eyes.eyes_m, [[0.03, 0, 0.6], [-0.03, 0, 0.6]])
    driver.close()
    with pytest.raises(SensorLost):
        driver.read_newest(0.01)


def test_its_failures_are_those_of_the_contract(port: Any) -> None:
    with pytest.raises(InputError, match="port"):
        open_sensor(SensorSettings(driver="udp-eyes", source="eth0"), MonotonicClock())
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", port))
        with pytest.raises(SensorLost):
            open_sensor(SensorSettings(driver="udp-eyes", source=str(port)), MonotonicClock()).open()
