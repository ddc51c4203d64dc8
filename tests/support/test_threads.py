"""Threads of parallel loops."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading

import cv2
import pytest

from runtime.support.background import before_all_others
from runtime.support.threads import parallel_map


def test_a_forked_process_starts_threads_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """It waited forever for those that only its parent has."""
    monkeypatch.setattr(cv2, "getNumThreads", lambda: 2)
    assert parallel_map(abs, [-1, -2, -3]) == [1, 2, 3]
    child = os.fork()
    if child == 0:
        signal.alarm(30)
        os._exit(0 if parallel_map(abs, [-1, -2, -3]) == [1, 2, 3] else 1)
    assert os.waitpid(child, 0)[1] == 0


def test_a_thread_that_outlives_the_main_one_still_works() -> None:
    """Pools take no more calls once the main thread has ended."""
    program = """
import threading
import cv2
from runtime.support.threads import parallel_map

def work():
    threading.main_thread().join()
    print(parallel_map(abs, [-1, -2, -3]))

cv2.setNumThreads(2)
threading.Thread(target=work).start()
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert (done.stdout, done.stderr) == ("[1, 2, 3]\n", "")


def test_the_presenter_comes_before_all_others_and_what_it_starts_does_not() -> None:
    """Policies and niceness of a thread within the block, of a thread started there, and after it."""
    found: list[tuple[int, int]] = []
    switching_s: list[float] = []

    def note() -> None:
        found.append((os.sched_getscheduler(0), os.getpriority(os.PRIO_PROCESS, threading.get_native_id())))
        switching_s.append(sys.getswitchinterval())

    def presenter() -> None:
        note()
        with before_all_others():
            note()
            started = threading.Thread(target=note)
            started.start()
            started.join()
        note()

    thread = threading.Thread(target=presenter)
    thread.start()
    thread.join()
    outside, within, started, after = found
    assert after == outside and switching_s[-1] == switching_s[0]
    assert started[0] == os.SCHED_OTHER and switching_s[1] < switching_s[0]
    if os.getuid() == 0:
        assert within[0] & ~os.SCHED_RESET_ON_FORK == os.SCHED_RR or within[1] < outside[1]
