"""Tests that long work reports its progress on terminals only."""

from __future__ import annotations

import io
import time

import pytest

from runtime.errors import InputError
from runtime.support import progress
from runtime.support.progress import ShownProgress, listening, task


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
    with listening(ShownProgress(terminal, after_s=0.05)):
        work(0.3)
    text = terminal.getvalue()
    assert "a.glb: parts" in text and "3/7" in text
    assert text.endswith("\x1b[1A\x1b[2K"), "the line is taken away at the end"


def test_a_quick_task_shows_nothing() -> None:
    terminal = Terminal()
    with listening(ShownProgress(terminal, after_s=0.5)):
        work(0.02)
    time.sleep(0.1)
    assert terminal.getvalue() == ""


def test_time_that_is_up_ends_the_work() -> None:
    with pytest.raises(InputError, match="too slow"), task("a", seconds=0.01, too_slow=InputError("a", "", "too slow")):
        time.sleep(0.05)
        progress.tell("a", 1)


def test_off_a_terminal_long_work_tells_where_it_is_now_and_then() -> None:
    log = io.StringIO()
    with listening(ShownProgress(log, now_and_then_s=0.1)):
        work(0.45)
    lines = log.getvalue().splitlines()
    assert 2 <= len(lines) <= 5
    assert all(line.startswith("0:00 a.glb: parts: 3 of 7") for line in lines)
