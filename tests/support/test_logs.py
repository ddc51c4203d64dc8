"""Tests that logging never delays its caller, reports lost lines and cannot be made to forge lines."""

from __future__ import annotations

import logging
import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from runtime.clock import NS_PER_S, SimulatedClock
from runtime.support import logs
from runtime.support.logs import BURST, QUEUED_MAX, configure

ROOT = Path(__file__).parents[2]
log = logging.getLogger("phasestack.test")


class File:
    """A log that is read when it is asked for."""

    def __init__(self, path: Path) -> None:
        self.stream = path.open("w+", encoding="utf-8")

    def getvalue(self) -> str:
        logs.flush()
        self.stream.seek(0)
        return self.stream.read()


@pytest.fixture
def file(tmp_path: Path) -> Iterator[File]:
    made = File(tmp_path / "log")
    yield made
    made.stream.close()


class Pipe:
    """A reader that reads on request."""

    def __init__(self) -> None:
        self.out, self._in = os.pipe()
        self.stream = open(self._in, "w", encoding="utf-8")  # noqa: SIM115, PTH123
        self.text = ""
        self._stop = threading.Event()

    def read_until(self, pattern: str, *, within_s: float = 60.0) -> re.Match[str]:
        deadline_s = time.monotonic() + within_s
        os.set_blocking(self.out, False)
        while not (found := re.search(pattern, self.text)):
            assert time.monotonic() < deadline_s, self.text[-500:]
            try:
                self.text += os.read(self.out, 1 << 20).decode()
            except BlockingIOError:
                time.sleep(0.005)
        return found

    def close(self) -> None:
        self.stream.close()
        os.close(self.out)


@pytest.fixture
def pipe() -> Iterator[Pipe]:
    made = Pipe()
    yield made
    logs.flush()
    made.close()


def configured(stream: Any, clock: SimulatedClock | None = None) -> None:
    configure(stream=stream, clock=clock or SimulatedClock(), environment={})


def say(text: str) -> None:
    """Past the rate limit."""
    log.info("%s", text, extra={"always": True})


def test_a_reader_that_never_reads_blocks_nobody(pipe: Pipe) -> None:
    configured(pipe.stream)
    count = 2 * QUEUED_MAX
    longest_s = 0.0
    for number in range(count):
        begin_s = time.monotonic()
        say(f"line {number} " + "x" * 100)
        longest_s = max(longest_s, time.monotonic() - begin_s)
    assert longest_s < 2.0  # without the thread a full pipe would block it forever
    pipe.read_until(f"line {QUEUED_MAX} x")
    say("and on")
    pipe.read_until("and on")


def test_the_last_lines_before_the_end_are_written() -> None:
    code = (
        "import logging; from runtime.support.logs import configure;"
        "configure(environment={});"
        "[logging.getLogger('phasestack').info('%d', n, extra={'always': True}) for n in range(500)]"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert [int(line.split()[-1]) for line in done.stderr.splitlines()] == list(range(500))


FORGERIES = [
    "lego\n12:00:00 error   state: tracking -> stopping (forged)",
    "lego\r12:00:00 error   forged",
    "lego\x1b[2K\x1b[1Aforged",
    "lego\u2028forged",
    "lego\x85forged",
    "lego\u202edegrof",
    "lego\0forged",
    "lego\udcffforged",
]


@pytest.mark.parametrize("text", FORGERIES)
def test_a_message_can_not_forge_a_line(file: File, text: str) -> None:
    configured(file.stream)
    log.info("asked for: scene %s", text)
    log.error(text)
    lines = file.getvalue().removesuffix("\n").split("\n")
    assert len(lines) == 2
    assert all(line.isprintable() for line in lines)
    assert all("lego" in line for line in lines)


def test_people_read_time_level_and_message(file: File) -> None:
    configured(file.stream)
    log.warning("sensor lost: %s", "openni2")
    assert file.getvalue().split(" ", 1)[1] == "warning sensor lost: openni2\n"


def test_journald_gets_a_priority_and_no_time(file: File) -> None:
    configure(stream=file.stream, environment={"JOURNAL_STREAM": "8:1"})
    log.error("first")
    assert file.getvalue() == "<3>first\n"


def test_a_traceback_is_in_a_file_that_the_line_names(
    file: File, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path / "logs"))
    configured(file.stream)
    try:
        raise ValueError("boom")
    except ValueError:
        log.exception("failed")
    told = file.getvalue()
    (report,) = (tmp_path / "logs").iterdir()
    assert told.count("\n") == 1 and "Traceback" not in told and "ValueError: boom" in told
    assert str(report) in told
    assert "Traceback" in report.read_text() and report.stat().st_mode & 0o777 == 0o600


def test_a_repeated_message_is_suppressed_and_counted_and_others_pass(file: File) -> None:
    clock = SimulatedClock()
    configured(file.stream, clock)
    for number in range(100):
        log.warning("model failed, %d", number)
        log.info("state: %s -> %s (%s)", "tracking", "holding", number, extra={"always": True})
    log.warning("something else")
    lines = file.getvalue().splitlines()
    assert len(lines) == BURST + 100 + 1 and sum("state:" in line for line in lines) == 100
    clock.advance_ns(60 * NS_PER_S)
    log.warning("model failed, %d", 100)
    assert f"({100 - BURST} similar messages suppressed)" in file.getvalue().splitlines()[-1]
