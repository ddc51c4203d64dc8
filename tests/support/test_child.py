"""Tests that a separate process returns arrays, texts and refusals, and that its crash is harmless."""

from __future__ import annotations

import errno
import logging
import os
import signal
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from runtime.errors import InputError, Stopped, TransientError, is_retryable
from runtime.support import child, progress
from runtime.support.untrusted_input import LIMITS
from tests.waiting import eventually

PATIENCE_S = 120.0


def run(work: Any, *given: Any, seconds: float = PATIENCE_S) -> Any:
    return child.in_child(work, *given, source="a.glb", seconds=seconds)


def arrays(count: int) -> dict[str, Any]:
    logging.getLogger("phasestack.content").warning("%d of them", count)
    progress.tell("counting", 1, count)
    shared = np.arange(count, dtype=np.float32)
    return {"a": shared, "again": shared, "odd": np.ones(7, np.uint8), "limit": LIMITS.triangles, "none": np.empty(0)}


def test_arrays_progress_and_log_lines_come_back(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[Any] = []
    monkeypatch.setattr(LIMITS, "triangles", 5)
    with progress.listening(lambda *what: told.append(what)):
        found = run(arrays, 100_000)
    assert np.array_equal(found["a"], np.arange(100_000)) and found["again"] is found["a"]
    assert found["odd"].sum() == 7 and found["limit"] == 5 and found["none"].shape == (0,)
    found["a"][0] = 3  # its own
    assert ("counting", 1, 100_000) in told and "100000 of them" in caplog.text


def ends(how: str) -> None:
    match how:
        case "refused":
            raise InputError("b.bin", "uri", "is not there")
        case "disk":
            try:
                raise OSError(errno.EIO, "failed")
            except OSError:
                raise InputError("b.bin", "", "cannot be read (failed)") from None
        case "bug":
            raise KeyError("x")
        case "memory":
            np.ones(1 << 30)
        case "hidden memory":
            try:
                np.ones(1 << 30)
            except MemoryError as error:
                raise InputError("b.bin", "", "cannot be read as a mesh") from error
        case "abort":
            os.abort()
        case "exit":
            sys.exit("no licence")
        case "hang":
            signal.pause()


@pytest.mark.parametrize(
    ("how", "line"),
    [
        ("refused", "b.bin: uri: is not there"),
        ("disk", "b.bin: cannot be read (failed)"),
        ("bug", "a.glb: cannot be read: KeyError: 'x'"),
        (
            "memory",
            "a.glb: needs more than 512 MiB of memory or crashed the process that read the file (exit status 1)",
        ),
        (
            "hidden memory",
            "a.glb: needs more than 512 MiB of memory or crashed the process that read the file (exit status 1)",
        ),
        (
            "abort",
            "a.glb: needs more than 512 MiB of memory or crashed the process that read the file (exit status -6)",
        ),
        ("exit", "a.glb: needs more than 512 MiB of memory or crashed the process that read the file (exit status 1)"),
        ("hang", "a.glb: was not loaded within 3 s"),
    ],
)
def test_whatever_ends_it_is_one_line(how: str, line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(child, "MEMORY_MAX", 512 << 20)
    begun_s = time.monotonic()
    with pytest.raises(InputError) as caught:
        run(ends, how, seconds=3 if how == "hang" else PATIENCE_S)
    assert str(caught.value) == line and time.monotonic() - begun_s < PATIENCE_S
    assert is_retryable(caught.value) is (how == "disk")  # its own limit of memory does not pass


def writes(path: str) -> None:
    Path(path).write_text(str(os.getpid()))
    while True:
        time.sleep(0.01)


def passes_on(path: str) -> None:
    run(writes, path, seconds=2 * PATIENCE_S)  # more than its own, which holds


def is_gone(number: int) -> bool:
    try:
        return psutil.Process(number).status() == psutil.STATUS_ZOMBIE  # nobody took its end in yet
    except psutil.NoSuchProcess:
        return True


@pytest.mark.parametrize("work", [writes, passes_on])
def test_who_listens_ends_it_and_it_is_gone(tmp_path: Path, work: Any) -> None:
    """Also a child's own child: a model that is tried out before a change takes it."""
    place = tmp_path / "pid"

    def listen(*_: object) -> None:
        if place.exists() and place.read_text():
            raise Stopped("a newer change came")

    with pytest.raises(Stopped), progress.listening(listen):
        run(work, str(place))
    number = int(place.read_text())
    if work is writes:
        with pytest.raises(ProcessLookupError):
            os.kill(number, 0)
    assert eventually(lambda: is_gone(number), within_s=20.0)


def test_no_process_at_the_moment_passes(monkeypatch: pytest.MonkeyPatch) -> None:
    opened = set(Path("/proc/self/fd").iterdir())
    monkeypatch.setattr(child.sys, "executable", "/nowhere/python")
    with pytest.raises(TransientError, match=r"a\.glb: cannot start a process to read the file"):
        run(arrays, 1)
    assert set(Path("/proc/self/fd").iterdir()) == opened


def spins() -> None:
    """Two seconds in one call that holds Python's lock, as parsers do."""
    sys.set_int_max_str_digits(0)
    str(7**400_000)


def test_this_process_goes_on_meanwhile() -> None:
    """The lock is this process's alone: a call that holds it in the child for seconds holds nobody here."""
    longest, done = [0.0], threading.Event()

    def tick() -> None:
        before_s = time.monotonic()
        while not done.is_set():
            time.sleep(0.005)
            now_s = time.monotonic()
            longest[0], before_s = max(longest[0], now_s - before_s), now_s

    thread = threading.Thread(target=tick)
    thread.start()
    begun_s = time.monotonic()
    run(spins)
    took_s = time.monotonic() - begun_s
    done.set()
    thread.join()
    assert longest[0] < 0.5 * took_s
