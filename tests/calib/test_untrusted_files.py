"""What is no regular file, wherever calibration reads one: told in a line, and never waited for."""

from __future__ import annotations

import os
import stat
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from calib.config_file import put, read_document, rewrite, save
from calib.pairs import PairsFile, read_pairs
from calib.photographs import read_photograph
from calib.setup_run import read_progress
from calib.setup_steps import gather
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


def test_a_rewritten_configuration_and_its_past_are_read_by_no_more_and_a_link_stays_one(tmp_path: Path) -> None:
    """A camera's password in it: setup made 0600 to 0644, and the link a file of its own."""
    (tmp_path / "kept").mkdir()
    config, link = tmp_path / "kept" / "display.toml", tmp_path / "phasestack.toml"
    config.write_text('[content]\nscene = "rtsp://user:secret@cam/1"\n')  # pragma: allowlist secret
    config.chmod(0o600)
    link.symlink_to(config)
    past = rewrite(link, lambda document: put(document, "calibration", {"viewing_m": [0.4, 0.7]}))
    assert link.is_symlink() and "viewing_m" in config.read_text()
    assert past is not None and past.parent == config.parent
    assert [stat.S_IMODE(path.stat().st_mode) for path in (config, past)] == [0o600, 0o600]
