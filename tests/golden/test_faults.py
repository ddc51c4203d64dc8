"""Golden runs that could not fail would be worth nothing: each of these faults, alone, must make one fail."""

from __future__ import annotations

import pytest

from tests.golden.faults import FAULTS, played

NAMED = {
    "eyes swapped", "a transposed matrix", "half a pixel", "the wrong branch", "panels swapped", "mm for m",
    "a dropped clip", "a stale solution", "a refresh lost",
}  # fmt: skip


def test_every_kind_of_fault_is_tried() -> None:
    assert {fault.kind for fault in FAULTS.values()} == NAMED


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_an_edit_of_what_is_there(name: str) -> None:
    compile(FAULTS[name].source(), name, "exec")


@pytest.mark.slow
@pytest.mark.parametrize("name", FAULTS)
def test_a_golden_run_notices(name: str) -> None:
    result = played(name)
    assert result.returncode == 1, f"{FAULTS[name].case} passes with {name}: {result.stdout}{result.stderr}"
    assert result.stdout.strip(), result.stderr  # a difference was told: it did not just break
