"""Tests that nothing in a recorded run changes by accident (`make golden` renews the references)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.golden.cases import CASES
from tests.golden.compare import PICTURE_FAR, as_lines, compare_picture, compare_text
from tests.golden.recordings import DATA, HEADS, path_to, write
from tests.golden.references import check, stored_text

MOST_BYTES = 1_200_000  # of all references and recordings


@pytest.mark.parametrize("case", CASES)
def test_a_recorded_run_is_as_it_is_stored(case: str, tmp_path: Path) -> None:
    lines = check(case, pictures=tmp_path)
    assert not lines, "\n".join(["", *lines, "if that is meant: make golden, and say why in the commit"])


@pytest.mark.parametrize("head", HEADS)
def test_a_kept_recording_is_the_one_that_its_seed_makes(head: str, tmp_path: Path) -> None:
    """Guards `--record`. Compares samples, not bytes: a writer may pack them differently."""
    from runtime.sensor.recording import Recording

    write(head, tmp_path / "again.mcap")
    kept, again = (list(Recording(path).samples()) for path in (path_to(head), tmp_path / "again.mcap"))
    assert [sample.capture_ns for sample in kept] == [sample.capture_ns for sample in again]
    for one, other in zip(kept, again, strict=True):
        assert (one.eyes is None) == (other.eyes is None)
        if one.eyes is not None and other.eyes is not None:
            np.testing.assert_allclose(one.eyes.eyes_m, other.eyes.eyes_m, atol=1e-9)


def test_together_the_runs_pass_every_state_and_label_but_the_end() -> None:
    lines = [line for case in CASES for line in (stored_text(case) or [])[1:]]
    assert {line["state"] for line in lines} == {"flat", "tracking", "holding", "degraded"}
    assert {line["eyes_label"] for line in lines} >= {"predicted", "held", "rested", "none"}
    assert {line["inference"] for line in lines} == {"ran", "reused", "skipped"}
    assert any(0 < line["flatness"] < 1 for line in lines)


def test_the_references_are_small() -> None:
    assert sum(path.stat().st_size for path in DATA.iterdir()) < MOST_BYTES


@pytest.mark.parametrize(
    ("stored", "now", "lines"),
    [
        ({"eyes_m": [[0.5, 0.1]]}, {"eyes_m": [[0.5, 0.100002]]}, ["eyes_m[0][1]: stored 0.1, now 0.100002"]),
        ({"eyes_m": [[0.5]]}, {"eyes_m": None}, ["eyes_m: stored [[0.5]], now None"]),
        ({"eyes_m": [0.1]}, {"eyes_m": [0.1 + 9e-7]}, []),
        ({"eyes_m": [0.1]}, {"eyes_m": [float("nan")]}, ["eyes_m[0]: stored 0.1, now nan"]),
        (
            {"psnr_db": [20.0] * 5},
            {"psnr_db": [20.0, 20.1, 20.2, 20.3, 20.4]},
            ["psnr_db[1]: stored 20, now 20.1; 3 more"],
        ),
        ({"state": "flat", "frame": 3}, {"state": "flat", "frame": 4}, ["frame: stored 3, now 4"]),
        ({"new": 1.0}, {"new": 1.0 + 1e-8}, ["new: stored 1, now 1.00000001"]),
        ({"a": 1}, {}, ["a: stored 1, now (absent)"]),
    ],
)
def test_a_difference_is_told_with_run_refresh_field_and_values(stored: Any, now: Any, lines: list[str]) -> None:
    assert as_lines("walk", compare_text([{}, stored], [{}, now])) == [f"walk: refresh 0 {line}" for line in lines]


def test_a_run_of_another_length_has_moved() -> None:
    assert [moved.field for moved in compare_text([{}, {}], [{}])] == ["refreshes"]


def test_a_picture_has_moved_by_its_mean_or_by_a_few_pixels() -> None:
    stored = np.full((3, 54, 96, 3), 100, np.uint8)
    assert compare_picture(stored, stored, number=1, what="panels") == []
    far = stored.copy()
    far[1, 0, :40] += np.uint8(PICTURE_FAR + 1)
    assert [moved.field for moved in compare_picture(stored, far, number=1, what="panels")] == [
        f"panels[1] share off by more than {PICTURE_FAR} codes"
    ]
    assert {moved.where for moved in compare_picture(stored, stored + np.uint8(1), number=7, what="panels")} == {7}
    assert compare_picture(None, stored, number=1, what="panels") != []
    assert compare_picture(stored[:2], stored, number=1, what="panels") != []
