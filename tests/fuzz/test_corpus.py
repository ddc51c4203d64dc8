"""Tests that files which once broke a reader, and new ones, are refused quickly and in little memory."""

from __future__ import annotations

import hashlib
import os
import resource
import time
from pathlib import Path

import pytest
from hypothesis import HealthCheck, Phase, given, settings

from runtime.errors import PhasestackError
from runtime.support.untrusted_input import LIMITS
from tests.fuzz.mutations import mutated
from tests.fuzz.targets import LOW, TARGETS

CORPUS = Path(__file__).parent / "corpus"
KEPT = sorted(path for path in CORPUS.glob("*/*") if path.is_file())
EXAMPLES = int(os.environ.get("FUZZ_EXAMPLES", "40"))  # of each reader; `make fuzz` tries thousands
HEAVY = {"checkpoint", "model"}  # their packages take seconds to load, or belong to their own tests
CASE_S, CASE_MIB = 10, 400  # that one file may take


@pytest.fixture(autouse=True)
def low_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in LOW.items():
        monkeypatch.setattr(LIMITS, name, value)


def read(name: str, data: bytes, folder: Path) -> None:
    """Raises where a reader does more than to refuse; the bytes are then kept in the corpus."""
    for path in folder.iterdir():
        path.unlink()
    start, before, told = time.monotonic(), peak_mib(), ""
    try:
        TARGETS[name].read(data, folder)
    except PhasestackError as error:
        told = str(error)
    except BaseException:
        keep(name, data)
        raise
    spent_s, grown_mib = time.monotonic() - start, peak_mib() - before
    if spent_s > CASE_S or grown_mib > CASE_MIB or "\n" in told or len(told) > 2000:
        pytest.fail(f"{keep(name, data)}: {spent_s:.1f} s, {grown_mib:.0f} MiB more, told {told!r}")


def peak_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def keep(name: str, data: bytes) -> Path:
    path = CORPUS / name / hashlib.sha256(data).hexdigest()[:12]
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("path", KEPT, ids=lambda path: f"{path.parent.name}-{path.name}")
def test_what_once_broke_a_reader_does_so_no_more(tmp_path: Path, path: Path) -> None:
    read(path.parent.name, path.read_bytes(), tmp_path)


@pytest.mark.parametrize("name", sorted(TARGETS))
def test_good_files_are_read_and_bad_ones_refused_in_one_line(tmp_path: Path, name: str) -> None:
    """Good files first: a target whose seeds are refused would try nothing."""
    seeds = TARGETS[name].seeds()
    assert seeds
    for data in seeds:
        TARGETS[name].read(data, tmp_path)
        for path in tmp_path.iterdir():
            path.unlink()
    if name in HEAVY and EXAMPLES == 40:
        return
    seeds += [path.read_bytes() for path in KEPT if path.parent.name == name]

    @settings(
        max_examples=EXAMPLES,
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(data=mutated(seeds))
    def tried(data: bytes) -> None:
        read(name, data, tmp_path)

    tried()
