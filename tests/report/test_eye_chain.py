"""The whole chain of the eyes: a real face before a simulated camera, to the decibels at its true eyes."""

from __future__ import annotations

import json
from pathlib import Path

from runtime.report.eye_chain import NETWORKS, NOISY, TRUE, measure, told
from runtime.support.artifacts import write_png
from tests.eyes.scene import eileen


def test_eyes_that_a_camera_sees_are_worth_more_than_points_with_3_mm_of_noise_and_no_more_than_the_truth(
    tmp_path: Path,
) -> None:
    face = eileen()
    write_png(tmp_path / "eileen.png", face.picture)
    row = {"file": "eileen.png", "left": face.pupils[0].tolist(), "right": face.pupils[1].tolist()}
    (tmp_path / "truth.json").write_text(json.dumps([row]))
    rows = measure(tmp_path, motions=("still",), seconds=0.8, scale=0.15)
    by_eyes = {row["eyes"]: row for row in rows}
    assert by_eyes[NETWORKS]["eyes_p50_mm"] < 2.5 < by_eyes[NOISY]["eyes_p95_mm"]
    assert by_eyes[TRUE]["eyes_p50_mm"] < 0.5
    at_true = {eyes: row["carried_db_true_eyes"] for eyes, row in by_eyes.items()}
    assert at_true[NOISY] < at_true[NETWORKS] < at_true[TRUE] + 0.5
    assert told(rows).count("\n") == len(rows)
