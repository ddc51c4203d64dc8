"""What may pass is told from what is wrong for good: 75 or carry on for the one, 2 for the other alone."""

from __future__ import annotations

import errno
import os
import resource
import subprocess
import sys
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from runtime.clock import MonotonicClock
from runtime.config import Overrides, SensorSettings, Settings
from runtime.daemon import supervise
from runtime.daemon.build import RunOptions
from runtime.daemon.metrics import CLIENTS_MAX, LOOPBACK, Metrics
from runtime.errors import InputError, SensorLost, TransientError
from runtime.sensor.base import Capabilities
from runtime.sensor.worker import SensorState, SensorWorker
from runtime.support.transient import PASSING, may_pass
from tests.daemon.test_metrics import free_port, scraped
from tests.waiting import eventually

ROOT = Path(__file__).parents[2]


def read_by_a_reader(number: int) -> InputError:
    """As every reader of files tells what the system refused."""
    try:
        try:
            raise OSError(number, os.strerror(number))
        except OSError as error:
            raise InputError("scene.glb", "", f"cannot be read ({error.strerror})") from None
    except InputError as error:
        return error


@pytest.mark.parametrize("number", sorted(PASSING))
def test_what_the_machine_lacks_passes_however_it_was_told(number: int) -> None:
    assert may_pass(OSError(number, "x"))
    assert may_pass(read_by_a_reader(number))


@pytest.mark.parametrize("number", [errno.ENOENT, errno.EACCES, errno.EISDIR, errno.EADDRINUSE, errno.ELOOP])
def test_what_is_wrong_for_good_does_not(number: int) -> None:
    assert not may_pass(read_by_a_reader(number))


def test_memory_and_threads_pass_and_so_do_libraries_words_for_them() -> None:
    for error in (
        MemoryError(),
        RuntimeError("can't start new thread"),
        RuntimeError("[ONNXRuntimeError] : 6 : RUNTIME_EXCEPTION : std::bad_alloc"),
        ImportError("libcuda.so: cannot open shared object file: Too many open files"),
        ImportError("onnxruntime_pybind11_state.so: failed to map segment from shared object"),
    ):
        assert may_pass(error)


def test_a_users_words_prove_nothing() -> None:
    assert not may_pass(InputError("too many open files.toml", "std::bad_alloc", "no space left on device"))


@pytest.mark.parametrize("error", [MemoryError(), OSError(errno.EMFILE, "x"), read_by_a_reader(errno.EIO)])
def test_a_run_that_the_machine_ended_may_be_started_again(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    monkeypatch.setattr(supervise, "drive", raising(error))
    with pytest.raises(TransientError, match=r"\w.* \(this may pass: start again"):
        lived()


@pytest.mark.parametrize("error", [read_by_a_reader(errno.ENOENT), InputError("a.toml", "x", "bad"), ValueError("x")])
def test_a_run_that_its_input_or_a_mistake_of_ours_ended_tells_just_that(
    monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    monkeypatch.setattr(supervise, "drive", raising(error))
    with pytest.raises(type(error)) as caught:
        lived()
    assert not isinstance(caught.value, TransientError)


def raising(error: Exception) -> Callable[..., Any]:
    def drive(*_: Settings | RunOptions | None, **__: Any) -> None:
        raise error

    return drive


def lived() -> None:
    overrides = Overrides(replay="demo", headless=True)
    supervise.run_daemon(None, overrides, frames=1, max_speed=True, out=None, scale=0.1, quiet=True)


def test_a_configuration_on_a_failing_disk_may_be_started_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(supervise, "load_settings", raising(read_by_a_reader(errno.EIO)))
    with pytest.raises(TransientError):
        lived()


@pytest.mark.parametrize("limit", [8, 10, 12, 14, 18, 24])
def test_without_descriptors_the_exit_code_is_never_that_of_bad_configuration(tmp_path: Path, limit: int) -> None:
    code = (
        "import resource, sys; from runtime.cli import main\n"
        "import runtime.commands.app, runtime.daemon.supervise, runtime.daemon.build\n"
        f"resource.setrlimit(resource.RLIMIT_NOFILE, ({limit}, {limit}))\n"
        "sys.argv = ['phasestack', 'run', '--headless', '--replay', 'demo', '--frames', '3', '--scale', '0.1']\n"
        "main()"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "XDG_RUNTIME_DIR": str(tmp_path), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode in (0, 75), (done.returncode, done.stderr)
    assert "Traceback" not in done.stderr


class Refusing:
    """A sensor that the system has no descriptor for, so often as it is told."""

    name, serial, overtaken, missed, refused = "refusing", "", 0, 0, {}
    capabilities = Capabilities(eye_points=True)

    def __init__(self, errors: list[Exception]) -> None:
        self._errors = errors

    def open(self) -> None:
        if self._errors:
            raise self._errors.pop(0)

    def read_arrived(self, timeout_s: float) -> None:
        raise SensorLost("open it was")

    def close(self) -> None:
        """Nothing is held."""


@pytest.mark.parametrize(("number", "opened"), [(errno.EMFILE, True), (errno.ENOMEM, True), (errno.ENOENT, False)])
def test_a_sensor_that_can_not_be_reopened_for_want_of_descriptors_is_tried_again(number: int, opened: bool) -> None:
    errors: list[Exception] = [read_by_a_reader(number), read_by_a_reader(number)]
    settings = SensorSettings(reopen_backoff_s=0.01, reopen_backoff_max_s=0.02)
    worker = SensorWorker(lambda: Refusing(errors), settings, MonotonicClock())
    worker.start()
    try:
        if opened:
            assert eventually(lambda: worker.reason == "open it was", within_s=20)
        else:
            assert eventually(lambda: worker.state is SensorState.FAILED, within_s=20)
            assert isinstance(worker.error, InputError)
    finally:
        worker.stop()


# The metrics' port


@pytest.fixture
def metrics() -> Iterator[Metrics]:
    made = Metrics()
    yield made
    made.close()


def test_a_thousand_connections_take_a_bounded_number_of_descriptors_and_scrapes_are_answered(metrics: Metrics) -> None:
    port = free_port()
    metrics.serve(port)
    code = (
        "import resource, socket, sys, time\n"
        "soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)\n"
        "resource.setrlimit(resource.RLIMIT_NOFILE, (min(hard, 2000), hard))\n"
        "held = []\n"
        "for _ in range(1000):\n"
        "    client = socket.socket(); client.settimeout(30)\n"
        f"    client.connect(('{LOOPBACK}', {port})); client.sendall(b'GET /me'); held.append(client)\n"
        "    time.sleep(0.003)\n"  # Linux drops what comes faster than it is let in, and tries again a second later
        "print('held', flush=True); sys.stdin.read()"
    )
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    assert hard >= 1100
    before = len(os.listdir("/proc/self/fd"))  # noqa: PTH208
    crowd = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    try:
        assert crowd.stdout.readline() == b"held\n"
        assert len(os.listdir("/proc/self/fd")) <= before + CLIENTS_MAX + 4  # noqa: PTH208
        for _ in range(5):
            assert 'phasestack_state{phasestack_state="starting"}' in scraped(port)
    finally:
        crowd.kill()
        crowd.communicate()


def test_a_port_that_is_taken_costs_the_figures_and_not_the_display(
    metrics: Metrics, caplog: pytest.LogCaptureFixture
) -> None:
    port = free_port()
    metrics.serve(port)
    with ExitStack() as cleanup:
        assert supervise._metrics(port, cleanup) is None
        assert supervise._metrics(0, cleanup) is None


def test_what_was_not_measured_has_no_figure(metrics: Metrics) -> None:
    port = free_port()
    metrics.serve(port)
    told = scraped(port)
    figures = {name: value for name, value in told.items() if value and not name.endswith("_created")}
    assert figures == {'phasestack_state{phasestack_state="starting"}': 1.0}


@pytest.mark.parametrize(
    ("request_bytes", "status"),
    [
        (b"GET /metrics HTTP/1.1\r\n\r\n", b"200"),
        (b"HEAD /metrics HTTP/1.0\r\nHost: x\r\n\r\n", b"200"),
        (b"GET /etc/passwd HTTP/1.1\r\n\r\n", b"404"),
        (b"POST /metrics HTTP/1.1\r\nContent-Length: 4\r\n\r\nabcd", b"405"),
        (b"nonsense\n\n", b"405"),
        (b"GET /" + b"x" * 20000, b"503"),
    ],
)
def test_whatever_is_asked_gets_one_short_answer(metrics: Metrics, request_bytes: bytes, status: bytes) -> None:
    import socket

    port = free_port()
    metrics.serve(port)
    with socket.create_connection((LOOPBACK, port), timeout=20) as client:
        client.sendall(request_bytes)
        answer = b""
        try:
            while data := client.recv(65536):
                answer += data
        except ConnectionResetError:
            pass  # what it had sent was not all read
    assert answer.split()[1] == status
    assert (b"phasestack_" in answer.partition(b"\r\n\r\n")[2]) == request_bytes.startswith(b"GET /metrics")


def test_it_is_what_prometheus_expects(metrics: Metrics) -> None:
    from prometheus_client.parser import text_string_to_metric_families

    port = free_port()
    metrics.serve(port)
    with urllib.request.urlopen(f"http://{LOOPBACK}:{port}/metrics", timeout=20) as answer:
        assert answer.headers["Content-Type"].startswith("text/plain")
        names = {family.name for family in text_string_to_metric_families(answer.read().decode())}
    assert "phasestack_stage_milliseconds" in names
