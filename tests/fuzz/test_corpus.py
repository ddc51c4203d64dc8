"""What once broke a reader, and a hundred new bad files each: refused in one line, in no time."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from runtime.errors import PhasestackError
from tests.fuzz.__main__ import CASE_S, CORPUS
from tests.fuzz.mutations import mutated
from tests.fuzz.targets import TARGETS

KEPT = sorted(path for path in CORPUS.glob("*/*") if path.is_file())
HEAVY = {"checkpoint", "model"}  # what they stand on takes seconds to load, or belongs to their own tests


def read(name: str, data: bytes, folder: Path) -> None:
    start = time.monotonic()
    try:
        TARGETS[name].read(data, folder)
    except PhasestackError as error:
        assert "\n" not in str(error) and len(str(error)) < 2000
    assert time.monotonic() - start < CASE_S


@pytest.mark.parametrize("path", KEPT, ids=lambda path: f"{path.parent.name}-{path.name}")
def test_what_once_broke_a_reader_does_so_no_more(tmp_path: Path, path: Path) -> None:
    read(path.parent.name, path.read_bytes(), tmp_path)


@pytest.mark.parametrize("name", sorted(TARGETS))
def test_good_files_are_read(tmp_path: Path, name: str) -> None:
    """A target whose seeds are refused would try nothing."""
    seeds = TARGETS[name].seeds()
    assert seeds
    for data in seeds:
        TARGETS[name].read(data, tmp_path)
        for path in tmp_path.iterdir():
            path.unlink()


@pytest.mark.parametrize("name", sorted(set(TARGETS) - HEAVY))
def test_bad_files_are_refused_in_one_line(tmp_path_factory: pytest.TempPathFactory, name: str) -> None:
    seeds = TARGETS[name].seeds()

    @settings(max_examples=40, deadline=None, database=None, suppress_health_check=list(HealthCheck))
    @given(data=mutated(seeds), number=st.just(0))
    def tried(data: bytes, number: int) -> None:
        read(name, data, tmp_path_factory.mktemp("fuzz"))

    tried()
