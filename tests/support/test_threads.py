"""Work at once: in the order that was asked for, with what it raises, and in a child that was forked."""

from __future__ import annotations

import os
import threading

import cv2
import pytest

from runtime.support.threads import at_once


@pytest.fixture(autouse=True)
def two_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cv2, "getNumThreads", lambda: 2)


def test_results_come_in_order_from_two_threads() -> None:
    both = threading.Barrier(2, timeout=10)

    def work(item: int) -> int:
        both.wait()  # nobody goes on alone
        return item * item

    assert at_once(work, [1, 2, 3, 4]) == [1, 4, 9, 16]


def test_what_it_raises_is_raised() -> None:
    with pytest.raises(ZeroDivisionError):
        at_once(lambda item: 1 // item, [1, 0])


@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
def test_a_forked_child_has_threads_of_its_own() -> None:
    assert at_once(abs, [-1, -2]) == [1, 2]
    child = os.fork()
    if child == 0:
        os._exit(0 if at_once(abs, [-3, -4]) == [3, 4] else 1)
    assert os.waitpid(child, 0)[1] == 0
