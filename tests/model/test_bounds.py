"""Compiled loops stay within their arrays: random pairs of the whole design range, with every index checked."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROLLED = 138  # of `bench robust`: eyes that see one row of the rear panel 46 rows apart


@pytest.mark.slow
@pytest.mark.parametrize(("first", "pairs"), [(0, 12), (ROLLED, 1)])
def test_no_index_lies_beside_an_array(tmp_path: Path, first: int, pairs: int) -> None:
    environment = os.environ | {"NUMBA_BOUNDSCHECK": "1", "XDG_CACHE_HOME": str(tmp_path)}
    command = ["bench", "robust", "--first", str(first), "--pairs", str(pairs)]
    answer = subprocess.run(
        [sys.executable, "-m", "runtime.cli", *command], env=environment, capture_output=True, text=True, timeout=900
    )
    assert answer.returncode == 0, answer.stderr
