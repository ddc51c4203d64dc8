"""What is no regular file, wherever calibration reads one: told in a line, and never waited for."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from calib.config_file import read_document, save
from calib.pairs import PairsFile, read_pairs
from calib.photographs import read_photograph
from calib.service_files import gather
from calib.setup_run import read_progress
from runtime.errors import InputError
from runtime.panels.lut import measured_curve

READERS = {
    "configuration": read_document,
    "pairs": read_pairs,
    "pairs to go on with": PairsFile,
    "photograph": read_photograph,
    "progress of setup": read_progress,
    "configuration of the service": lambda path: gather(path, path.parent / "out"),
    "calibration that is kept": lambda path: save(path, "new"),
    "lut": measured_curve,
}


def answer_of(reader: Any, path: Path) -> str:
    """The refusal; a test that fails where there is none within ten seconds."""
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(reader, path)
        try:
            error = waiting.exception(timeout=10)
        except TimeoutError:
            os.close(os.open(path, os.O_WRONLY | os.O_NONBLOCK))  # lets go of who waits for a writer
            raise
    assert isinstance(error, InputError), error
    return str(error)


@pytest.mark.parametrize("name", READERS)
def test_a_fifo_is_refused(name: str, tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    os.mkfifo(path)
    told = answer_of(READERS[name], path)
    assert "a.toml" in told
    assert "FIFO" in told or "is not what setup wrote" in told
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.toml"]
