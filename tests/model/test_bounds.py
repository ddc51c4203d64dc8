"""Compiled loops stay within their arrays: what holds them is run once more with every index checked."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.slow
@pytest.mark.parametrize("held_by", ["test_compiled.py", "test_phasors.py"])
def test_no_index_lies_beside_an_array(tmp_path: Path, held_by: str) -> None:
    environment = os.environ | {"NUMBA_BOUNDSCHECK": "1", "XDG_CACHE_HOME": str(tmp_path)}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(Path(__file__).with_name(held_by))]
    answer = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=900)
    assert answer.returncode == 0, answer.stdout
