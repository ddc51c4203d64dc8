"""Tests that a sensor which crashes or hangs costs no refresh, and that the viewer is tracked again."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from typing import Any

import pytest

from tests.daemon.rig import TRACKING, Rig


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    sensor: dict[str, Any] = {
        "driver": "tests.sensor.harmful:Harmful",
        "options": {"file": str(tmp_path_factory.mktemp("sensor") / "deed")},
        "timeout_s": 0.1,
    }
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("STATE_DIRECTORY", str(tmp_path_factory.mktemp("state")))
        with Rig(sensor=sensor) as made:
            made.refresh_until_solved()
            yield made


@pytest.mark.parametrize(
    ("how", "reason"), [(signal.SIGSEGV, "ended by SIGSEGV"), (signal.SIGSTOP, "not answered in time")]
)
def test_whatever_ends_the_sensor_all_refreshes_are_presented(rig: Rig, how: int, reason: str) -> None:
    rig.refresh_until(TRACKING)
    (before,) = rig.presenter.samples.status()
    first = len(rig.accounts)
    os.kill(before["pid"], how)
    rig.refresh_until("degraded: sensor")
    assert reason in rig.presenter.machine.reason
    rig.refresh_until(TRACKING)
    assert all(account.presented for account in rig.accounts[first:]) and rig.presenter.stats.dropped == 0
    processes = {process["role"]: process for process in rig.run.processes()}
    assert processes["sensor"]["restarts"] == before["restarts"] + 1
    assert processes["sensor"]["pid"] not in (before["pid"], None)
    assert processes["sensor"]["memory_mib"] > 5 and processes["sensor"]["cpu_s"] >= 0
