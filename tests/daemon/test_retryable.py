"""Tests that temporary faults (exit 75) are distinguished from permanent ones (exit 2)."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import pytest

from runtime.clock import MonotonicClock
from runtime.config import SensorSettings, Settings
from runtime.daemon import supervise
from runtime.daemon.build import RunOptions
from runtime.errors import PASSING, InputError, SensorLost, TransientError, is_retryable
from runtime.sensor.base import Capabilities
from runtime.sensor.live import SensorSetup, SensorThread
from runtime.sensor.polling import SensorState
from tests.waiting import eventually

ROOT = Path(__file__).parents[2]


def read_by_a_reader(number: int) -> InputError:
    """InputError as file readers raise it for an OSError."""
    try:
        try:
            raise OSError(number, os.strerror(number))
        except OSError as error:
            raise InputError("scene.glb", "", f"cannot be read ({error.strerror})") from None
    except InputError as error:
        return error


@pytest.mark.parametrize("number", sorted(PASSING))
def test_what_the_machine_lacks_passes_however_it_was_told(number: int) -> None:
    assert is_retryable(OSError(number, "x"))
    assert is_retryable(read_by_a_reader(number))


@pytest.mark.parametrize("error", [MemoryError(), OSError(errno.EMFILE, "x"), read_by_a_reader(errno.EIO)])
def test_a_run_that_the_machine_ended_may_be_started_again(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    monkeypatch.setattr(supervise, "drive", raising(error))
    with pytest.raises(TransientError, match=r"\w.* \(temporary: try again"):
        lived()


@pytest.mark.parametrize("error", [read_by_a_reader(errno.ENOENT), InputError("a.toml", "x", "bad"), ValueError("x")])
def test_a_run_ended_by_its_input_or_a_bug_reports_just_that(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    monkeypatch.setattr(supervise, "drive", raising(error))
    with pytest.raises(type(error)) as caught:
        lived()
    assert not isinstance(caught.value, TransientError)


def raising(error: Exception) -> Callable[..., Any]:
    def drive(*_: Settings | RunOptions | None, **__: Any) -> None:
        raise error

    return drive


def lived(read_settings: Callable[[], Settings] = Settings) -> None:
    supervise.run_daemon(read_settings, RunOptions(max_speed=True, frames=1, scale=0.1))


@pytest.mark.parametrize("limit", [8, 12])
def test_without_descriptors_the_exit_code_is_never_that_of_bad_configuration(tmp_path: Path, limit: int) -> None:
    code = (
        "import resource, sys; from runtime.cli import main\n"
        "import runtime.commands.app, runtime.daemon.supervise, runtime.daemon.build\n"
        f"resource.setrlimit(resource.RLIMIT_NOFILE, ({limit}, {limit}))\n"
        "sys.argv = 'phasestack run --headless --replay demo --frames 1 --scale 0.1 --model fast'.split()\n"
        "main()"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "XDG_RUNTIME_DIR": str(tmp_path), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode in (0, 75), (done.returncode, done.stderr)
    assert "Traceback" not in done.stderr


class Refusing:
    """Sensor that fails to open a given number of times for lack of descriptors."""

    name, serial, skipped, missed = "refusing", "", 0, 0
    refused: ClassVar[dict[str, int]] = {}
    capabilities = Capabilities(eye_points=True)

    def __init__(self, errors: list[Exception]) -> None:
        self._errors = errors

    def open(self) -> None:
        if self._errors:
            raise self._errors.pop(0)

    def read_arrived(self, timeout_s: float) -> None:
        raise SensorLost("open it was")

    def close(self) -> None:
        """Do nothing."""


@pytest.mark.parametrize(("number", "opened"), [(errno.EMFILE, True), (errno.ENOMEM, True), (errno.ENOENT, False)])
def test_a_sensor_that_lacks_descriptors_to_reopen_is_tried_again(number: int, opened: bool) -> None:
    errors: list[Exception] = [read_by_a_reader(number), read_by_a_reader(number)]
    sensor: Any = Refusing
    worker = SensorThread(SensorSetup(lambda: sensor(errors), SensorSettings(), MonotonicClock()))
    worker.start()
    try:
        if opened:
            assert eventually(lambda: worker.state is not None and worker.reason == "open it was", within_s=20)
        else:
            assert eventually(lambda: worker.state is SensorState.FAILED, within_s=20)
            assert isinstance(worker.error, InputError)
    finally:
        worker.close()
