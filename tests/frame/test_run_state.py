"""Tests that the parts of a run change as a whole or not at all."""

from __future__ import annotations

import threading
from typing import Any

import pytest

from runtime.config import Settings
from runtime.eyes.calibration import load_calibration
from runtime.frame.run_state import RunCell


class Part:
    """Stand-in for content or a model, compared by identity."""


@pytest.fixture
def cell() -> RunCell:
    return RunCell(Settings(), calibration=load_calibration(None), content=Part(), predictor=Part())


def test_concurrent_changes_are_all_made_and_each_part_handed_back_once(cell: RunCell) -> None:
    handed_back: list[Any] = []
    mine = [[Part() for _ in range(50)] for _ in range(4)]

    def change(parts: Any) -> None:
        handed_back.extend(cell.replace(content=part).content for part in parts)

    first = cell.state.content
    threads = [threading.Thread(target=change, args=(parts,)) for parts in mine]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert cell.state.version == 200
    everything = {id(part) for parts in mine for part in parts} | {id(first)}
    assert {id(part) for part in handed_back} | {id(cell.state.content)} == everything
    assert len(handed_back) == len(set(map(id, handed_back)))
