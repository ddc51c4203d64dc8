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


def faults(how: str) -> int:
    """Page faults of ten turns that fill five pictures each."""
    done = subprocess.run([sys.executable, "-c", PROGRAM, how], capture_output=True, text=True, check=True)
    if not done.stdout.strip().isdigit():
        pytest.skip(done.stdout.strip())
    return int(done.stdout)


def test_the_pages_of_one_picture_serve_the_next() -> None:
    assert faults("keep") < faults("leave") / 10
