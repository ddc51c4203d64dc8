"""Tests that a driver which crashes or hangs ends only its own process, and that another one takes over."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import psutil
import pytest

from runtime.clock import MonotonicClock
from runtime.config import SensorSettings
from runtime.errors import FatalError, InputError
from runtime.records import SensorFrame
from runtime.sensor.live import SensorProcess, SensorSetup
from runtime.sensor.polling import PICTURES_MAX
from runtime.sensor.registry import open_sensor
from tests.sensor.harmful import PICTURE_PX, Large
from tests.waiting import eventually

REASONS = {  # tests/support/test_process.py tries all deeds on a process without a driver
    "crash": "ended by SIGSEGV",
    "loop": "not answered in time",
    "exit": "SystemExit: no licence",
}


@pytest.fixture(scope="module")
def deed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """File that says what the driver is to do."""
    return tmp_path_factory.mktemp("sensor") / "deed"


@pytest.fixture(scope="module")
def start(deed: Path) -> Iterator[Callable[..., SensorProcess]]:
    with pytest.MonkeyPatch.context() as patch, ExitStack() as cleanup:
        patch.setenv("STATE_DIRECTORY", str(deed.parent))

        def begin(driver: str = "tests.sensor.harmful:Harmful", **options: Any) -> SensorProcess:
            settings = SensorSettings(driver=driver, options={"file": str(deed)} | options, timeout_s=0.1)
            clock = MonotonicClock()
            sensor = SensorProcess(SensorSetup(partial(open_sensor, settings, clock), settings, clock))
            cleanup.callback(sensor.close)
            sensor.start()
            return sensor

        yield begin


@pytest.fixture(scope="module")
def sensor(start: Callable[..., SensorProcess]) -> SensorProcess:
    return start()


def process(sensor: SensorProcess) -> psutil.Process:
    return psutil.Process(sensor.status()[0]["pid"])


def until_running(sensor: SensorProcess) -> SensorFrame:
    """The first sample that arrives."""
    frames: list[SensorFrame] = []
    assert eventually(lambda: bool(frames.__iadd__(sensor.take())) and sensor.fault() == "")
    return frames[0]


@pytest.mark.parametrize("what", REASONS)
def test_whatever_a_driver_does_its_reason_is_told_and_samples_return(
    sensor: SensorProcess, deed: Path, what: str
) -> None:
    until_running(sensor)
    serial, before = sensor.serial, process(sensor)
    deed.write_text(what)
    assert eventually(lambda: sensor.take() == [] and REASONS[what] in sensor.fault()), sensor.fault()
    deed.unlink(missing_ok=True)
    assert until_running(sensor).sequence < 100
    assert sensor.serial == serial  # the same device is opened again
    assert before.is_running() == (what == "exit")


def test_samples_skipped_by_a_process_that_has_ended_still_count(sensor: SensorProcess) -> None:
    until_running(sensor)
    assert eventually(lambda: bool(sensor.state) and len(sensor._frames) > 3)
    sensor.arrived(0)
    before = sensor.stale_inputs
    process(sensor).kill()
    until_running(sensor)
    assert sensor.stale_inputs >= before > 0


def test_a_fault_is_told_until_samples_arrive_again(start: Callable[..., SensorProcess], tmp_path: Path) -> None:
    sensor = start(opening=True, file=str(tmp_path / "deed"))
    until_running(sensor)
    (tmp_path / "deed").write_text("crash")
    process(sensor).kill()
    assert eventually(lambda: sensor.take() is not None and sensor.fault() != "")
    faults = set[str]()
    assert eventually(lambda: bool(sensor.take() or faults.add(sensor.fault()) or "SIGSEGV" in sensor.fault()))
    assert "" not in faults and any("SIGKILL" in fault for fault in faults)
    sensor.close()


def test_a_driver_that_cannot_be_created_is_refused_at_the_start(start: Callable[..., SensorProcess]) -> None:
    with pytest.raises(InputError, match="unknown driver 'crystal-ball'"):
        start("crystal-ball")


def test_a_fatal_error_ends_the_run(start: Callable[..., SensorProcess], tmp_path: Path) -> None:
    (tmp_path / "deed").write_text("refuse")
    sensor = start(opening=True, file=str(tmp_path / "deed"))
    with pytest.raises(FatalError, match="no such device"):
        eventually(lambda: bool(sensor.arrived(0)))
    assert sensor.status()[0]["restarts"] == 0
    sensor.close()


def test_the_process_reports_what_it_uses(sensor: SensorProcess) -> None:
    until_running(sensor)
    (status,) = sensor.status()
    assert status["role"] == "sensor" and 5 < status["memory_mib"] < 500 and status["cpu_s"] > 0
    scores = [int(Path(f"/proc/{pid}/oom_score_adj").read_text()) for pid in (os.getpid(), status["pid"])]
    assert scores[1] > scores[0]


def test_pictures_are_passed_whole_and_unread_ones_do_not_pile_up(tmp_path: Path) -> None:
    (count := tmp_path / "count").touch()
    sensor = SensorProcess(
        SensorSetup(partial(Large, count), SensorSettings(timeout_s=1.0), MonotonicClock(), keep_images=True)
    )
    try:
        sensor.start()
        assert eventually(lambda: int(count.read_text() or 0) > 5 * PICTURES_MAX)
        frames = sensor.take()
        assert 0 < len(frames) <= 4 * PICTURES_MAX
        for frame in frames:
            assert frame.colour is not None and frame.colour.shape == (*PICTURE_PX, 3)
            assert (frame.colour == frame.sequence % 256).all()
        assert all(before.sequence < frame.sequence for before, frame in pairwise(frames))
        assert eventually(lambda: sensor.take() != [] and sensor.stale_inputs > 0)
    finally:
        sensor.close()
