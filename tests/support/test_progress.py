"""Long work tells how far it is; a terminal shows what takes long, and nothing else is written to."""

from __future__ import annotations

import io
import time

import pytest

from runtime.errors import InputError
from runtime.support import progress
from runtime.support.progress import TerminalLine, listening, task
from tests.waiting import eventually


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def work(seconds: float) -> None:
    with task("loading a.glb", seconds=60, too_slow=InputError("a.glb", "", "too slow")):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            progress.tell("a.glb: parts", 3, 7)
            time.sleep(0.01)


def test_a_task_that_takes_long_is_shown_and_its_line_taken_away() -> None:
    terminal = Terminal()
    with listening(TerminalLine(terminal, after_s=0.05, every_s=0.02)):
        work(0.3)
    assert eventually(lambda: terminal.getvalue().endswith("\r\x1b[K"))
    assert "a.glb: parts 3 of 7" in terminal.getvalue() and "\n" not in terminal.getvalue()


def test_a_quick_task_shows_nothing() -> None:
    terminal = Terminal()
    with listening(TerminalLine(terminal, after_s=0.5, every_s=0.02)):
        work(0.02)
    time.sleep(0.1)
    assert terminal.getvalue() == ""


def test_what_is_no_terminal_is_never_written_to() -> None:
    file = io.StringIO()
    with listening(TerminalLine(file, after_s=0.0, every_s=0.01)):
        work(0.1)
    assert file.getvalue() == ""


def test_nobody_need_listen() -> None:
    work(0.01)


def test_time_that_is_up_ends_the_work() -> None:
    with pytest.raises(InputError, match="too slow"), task("a", seconds=0.01, too_slow=InputError("a", "", "too slow")):
        time.sleep(0.05)
        progress.tell("a", 1)


def test_off_a_terminal_long_work_tells_where_it_is_now_and_then() -> None:
    log = io.StringIO()
    with listening(TerminalLine(log, now_and_then_s=0.1)):
        work(0.45)
    lines = log.getvalue().splitlines()
    assert 2 <= len(lines) <= 5
    assert all(line.startswith("0:00 a.glb: parts: 3 of 7") for line in lines)


def test_off_a_terminal_quick_work_tells_nothing() -> None:
    log = io.StringIO()
    with listening(TerminalLine(log)):
        work(0.02)
    assert log.getvalue() == ""
