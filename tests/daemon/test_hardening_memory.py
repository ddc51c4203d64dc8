"""What a change of scene or model replaced goes back to the system."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from runtime.support.memory import give_back

ROOT = Path(__file__).parents[2]

# A quarter of a GiB in pieces, of which every fiftieth is kept: the C library returns none of the others by itself.
FRAGMENTED = """
import psutil
from runtime.support.memory import give_back
size = psutil.Process().memory_info
pieces = [b"x" * (65000 + k % 2) for k in range(4000)]
full = size().rss
kept = pieces[::50]
del pieces
before = size().rss
give_back()
print(full, before, size().rss)
"""


@pytest.mark.skipif(not give_back(), reason="a C library without malloc_trim")
def test_what_lies_between_pieces_in_use_goes_back() -> None:
    done = subprocess.run([sys.executable, "-c", FRAGMENTED], cwd=ROOT, capture_output=True, text=True, check=True)
    full, before, after = (int(word) for word in done.stdout.split())
    freed = 4000 * 65000 * 49 // 50
    assert full - before < freed / 2
    assert full - after > freed * 0.8
