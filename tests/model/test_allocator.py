"""Memory for pictures: asked for once, kept after."""

from __future__ import annotations

import subprocess
import sys

import pytest

PROGRAM = """
import resource, sys
import numpy as np
from runtime.support.memory import keep_freed_memory

if sys.argv[1] == "keep" and not keep_freed_memory():
    print("another C library")
    sys.exit()
for turn in range(12):
    if turn == 2:
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    pictures = [np.empty((1080, 1920, 3), np.int16) for _ in range(5)]
    for picture in pictures:
        picture[:, ::64] = 1
    del picture, pictures
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""

IN_THREADS = """
import sys, threading
import numpy as np, psutil
from runtime.support.memory import give_back, keep_freed_memory

if not keep_freed_memory():
    print("another C library")
    sys.exit()

def used():
    pictures = [np.ones((1080, 1920, 3), np.uint8) for _ in range(2)]
    all_at_once.wait()
    del pictures
    all_at_once.wait()

before = psutil.Process().memory_info().rss
for _ in range(2):
    all_at_once = threading.Barrier(12)
    threads = [threading.Thread(target=used) for _ in range(12)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
give_back()
print(max(0, psutil.Process().memory_info().rss - before) >> 20)
"""


def answered(program: str, *how: str) -> int:
    done = subprocess.run([sys.executable, "-c", program, *how], capture_output=True, text=True, check=True)
    if not done.stdout.strip().isdigit():
        pytest.skip(done.stdout.strip())
    return int(done.stdout)


def test_the_pages_of_one_picture_serve_the_next() -> None:
    assert answered(PROGRAM, "keep") < answered(PROGRAM, "leave") / 10  # page faults of ten turns, five pictures each


def test_what_threads_had_at_once_goes_back_to_the_system() -> None:
    """A heap of each thread's own would keep its end: 12 MiB times twelve, and a daemon's threads are ever new ones."""
    assert answered(IN_THREADS) < 40
