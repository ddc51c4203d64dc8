"""Tests that a worker's process is watched, killed if it hangs, and started again, and that its parent never waits."""

from __future__ import annotations

import logging
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from runtime.errors import InputError, TransientError, is_retryable
from runtime.support.channel import Channel, ChannelClosed
from runtime.support.process import Began, Ended, Parent, Role, Worker
from tests.deeds import DEEDS
from tests.waiting import eventually

LIMIT_S = 0.5
PATIENCE_S = 60.0


def answers(parent: Parent, greeting: str) -> None:
    """Worker that does what its messages say."""
    parent.send(greeting)
    parent.ready()
    while True:
        parent.allow(LIMIT_S + 1)
        for kind, value in parent.receive(0.1):
            if kind == "echo":
                parent.send(value)
            elif kind == "do":
                parent.allow(PATIENCE_S if value == "grow" else LIMIT_S)
                WORKER_DEEDS[value]()


def _grows() -> None:
    kept = []
    for _ in range(4000):  # 4 GB
        kept.append(np.ones(1 << 17))
        time.sleep(1e-4)


def _raises() -> None:
    raise ZeroDivisionError("a bug")


WORKER_DEEDS = DEEDS | {
    "grow": _grows,
    "raise": _raises,
    "log": lambda: logging.getLogger("phasestack.solver").warning("from the worker"),
}
NAMES = {
    "crash": "SIGSEGV",
    "die": "SIGKILL",
    "stop": "not answered",
    "loop": "not answered",
    "sleep": "not answered",
    "exit": "failed: no licence",
    "grow": "memory limit",
    "raise": "ZeroDivisionError",
}


def refuses(parent: Parent) -> None:
    raise InputError("a.toml", "scene", "is unknown")


def has_no_room(parent: Parent) -> None:
    try:
        raise MemoryError
    except MemoryError as error:
        raise InputError("a.toml", "", "cannot be read") from error


def never_ready(parent: Parent) -> None:
    time.sleep(3600)


@pytest.fixture(autouse=True)
def reports(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder for crash reports."""
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    return tmp_path


@pytest.fixture
def cleanup() -> Iterator[ExitStack]:
    with ExitStack() as made:
        yield made


def started(cleanup: ExitStack, main: Callable[..., None], *arguments: Any, **limits: Any) -> Worker:
    worker = Worker(Role("worker", main, **limits), lambda: arguments)
    cleanup.callback(worker.close)
    return worker


@pytest.fixture
def worker(cleanup: ExitStack) -> Worker:
    made = started(cleanup, answers, "hello", memory_bytes=1 << 29, niceness=5)
    made.wait_ready()
    assert received(made, 2) == [Began(1), "hello"]
    return made


def received(worker: Worker, count: int) -> list[Any]:
    """The next messages, of which there are at least `count`."""
    messages: list[Any] = []
    assert eventually(lambda: len(messages.__iadd__(worker.receive())) >= count), messages
    return messages


def process(worker: Worker) -> psutil.Process:
    return psutil.Process(worker.status()["pid"])


def test_messages_and_large_arrays_arrive_in_order(worker: Worker) -> None:
    picture = np.random.default_rng(1).integers(0, 256, (1080, 1920, 3), np.uint8)
    for value in (1, picture, {"small": np.arange(5)}, "x" * 300_000, None):
        assert worker.send(("echo", value))
    first, large, small, text, nothing = received(worker, 5)
    assert first == 1 and np.array_equal(large, picture) and np.array_equal(small["small"], np.arange(5))
    assert text == "x" * 300_000 and nothing is None


def test_messages_to_a_stopped_worker_are_refused_and_never_waited_for(worker: Worker) -> None:
    process(worker).suspend()
    sent = 0
    while worker.send(("echo", "y" * 1000)):
        sent += 1
    process(worker).resume()
    assert sent > 10 and received(worker, sent)[:sent] == ["y" * 1000] * sent


@pytest.mark.parametrize("deed", NAMES)
def test_whatever_ends_a_worker_another_one_is_started(worker: Worker, deed: str, reports: Path) -> None:
    before, begun_s = process(worker), time.monotonic()
    worker.send(("do", deed))
    ended, began, hello = received(worker, 3)
    assert isinstance(ended, Ended) and NAMES[deed] in ended.reason
    assert began == Began(2) and hello == "hello"
    assert not before.is_running() and time.monotonic() - begun_s < PATIENCE_S
    assert eventually(lambda: worker.is_ready) and worker.restarts == 1 and worker.fault == ""
    assert worker.send(("echo", 7)) and received(worker, 1) == [7]
    trace = "".join(path.read_text() for path in reports.glob("phasestack-error-*.log"))
    assert ("string_at" in trace) == (deed == "crash") and ("_raises" in trace) == (deed == "raise")


def test_no_descriptor_process_or_thread_is_left_by_workers_that_die(worker: Worker) -> None:
    def count() -> tuple[int, int, int]:
        me = psutil.Process()
        return me.num_fds(), len(me.children()), me.num_threads()

    def die() -> None:
        before = worker.restarts
        worker.send(("do", "die"))
        assert eventually(lambda: worker.receive() is not None and worker.restarts > before and worker.is_ready)
        worker.receive()

    die()
    before = count()
    for _ in range(3):
        die()
    assert count() == before


def test_log_lines_are_passed_on(worker: Worker, caplog: pytest.LogCaptureFixture) -> None:
    worker.send(("do", "log"))
    assert eventually(lambda: "from the worker" in caplog.text)


def test_a_worker_reports_what_it_uses_and_runs_at_its_own_niceness(worker: Worker) -> None:
    status = worker.status()
    assert (status["role"], status["restarts"]) == ("worker", 0)
    assert 5 < status["memory_mib"] < 500 and 0 < status["cpu_s"] < 60
    assert process(worker).nice() == os.nice(0) + 5 or process(worker).nice() == 5
    assert Path(f"/proc/{status['pid']}/oom_score_adj").read_text().strip() != "0"


@pytest.mark.parametrize(("main", "error"), [(refuses, InputError), (has_no_room, InputError)])
def test_what_prevents_the_first_start_is_raised(cleanup: ExitStack, main: Any, error: type[Exception]) -> None:
    worker = started(cleanup, main)
    with pytest.raises(error, match=r"a\.toml") as raised:
        worker.wait_ready()
    assert is_retryable(raised.value) == (main is has_no_room)
    assert worker.restarts == 0


def test_a_worker_that_is_never_ready_is_killed(cleanup: ExitStack) -> None:
    worker = started(cleanup, never_ready, start_s=LIMIT_S)
    with pytest.raises(TransientError, match="not answered"):
        worker.wait_ready()


def test_a_shortage_of_descriptors_is_reported_at_the_start(cleanup: ExitStack) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (psutil.Process().num_fds(), hard))
    try:
        worker = started(cleanup, answers, "hello")
        with pytest.raises(TransientError, match="cannot be started"):
            worker.wait_ready()
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_waiting_for_the_first_worker_can_be_ended(cleanup: ExitStack) -> None:
    worker = started(cleanup, never_ready)
    worker.wait_ready(lambda: False)
    assert not worker.is_ready and worker.send("lost") is False


def test_a_worker_is_restarted_on_request_with_the_reason(worker: Worker) -> None:
    worker.restart("has lost its OpenGL context")
    assert received(worker, 3)[:2] == [Ended("the worker has lost its OpenGL context"), Began(2)]


PARENT = """
import time
from runtime.support.process import Role, Worker
from tests.support.test_process import answers
worker = Worker(Role("worker", answers), lambda: ("hello",))
worker.wait_ready()
print(worker.status()["pid"], flush=True)
time.sleep(3600)
"""


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM])
def test_a_worker_ends_with_its_parent(how: int) -> None:
    with subprocess.Popen([sys.executable, "-c", PARENT], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        worker = psutil.Process(int(parent.stdout.readline()))
        parent.send_signal(how)
    assert eventually(lambda: not worker.is_running() or worker.status() == psutil.STATUS_ZOMBIE)


def test_a_closed_channel_is_reported_after_its_last_message() -> None:
    ours, theirs = Channel.pair()
    theirs.send("last")
    theirs.close()
    assert ours.receive() == ["last"]
    with pytest.raises(ChannelClosed):
        ours.receive()
    with pytest.raises(ChannelClosed):
        ours.send("late")
    ours.close()
