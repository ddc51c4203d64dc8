"""Threads of parallel loops."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator

import cv2
import pytest

from runtime.support.background import set_niceness
from runtime.support.threads import fresh_threads, parallel_map


@pytest.fixture
def two_threads() -> Iterator[None]:
    fresh_threads()
    before = cv2.getNumThreads()
    cv2.setNumThreads(2)
    yield
    cv2.setNumThreads(before)
    fresh_threads()


def priorities() -> list[int]:
    """Niceness of the caller and the pool's two threads, which meet."""
    met = threading.Barrier(3, timeout=60.0)

    def own(_item: int) -> int:
        met.wait()
        return os.getpriority(os.PRIO_PROCESS, threading.get_native_id())

    return parallel_map(own, range(3))


@pytest.mark.usefixtures("two_threads")
def test_fresh_threads_have_the_niceness_of_their_caller() -> None:
    def measure() -> None:
        set_niceness(19)
        priorities()

    low = threading.Thread(target=measure)
    low.start()
    low.join()
    own, *pool = priorities()
    assert pool == [19, 19]
    fresh_threads()
    assert priorities() == [own] * 3
