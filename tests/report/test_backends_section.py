"""The report's two backends side by side."""

from __future__ import annotations

from dataclasses import replace

import pytest

from runtime.config import StackGeometry
from runtime.errors import MissingPart
from runtime.report import backends_section as side
from runtime.report.backends_section import STAGES, backends_section

SMALL = replace(StackGeometry().stack(), width_px=160, height_px=90)


def test_both_are_measured_in_one_run_stage_by_stage_with_what_crosses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(side, "RUNS", 1)
    section, record = backends_section(["fast"], SMALL)
    (one,) = record["models"]
    assert one["times_as_many"] == pytest.approx(one["opencv_ms"] / one["gl_ms"])
    assert list(one["gpu_ms"]) == list(STAGES)
    assert all(ms > 0 for ms in one["gpu_ms"].values())
    assert one["passes"] > 10
    pictures_and_layers = 5 * 160 * 90 * 4
    assert one["crossing_bytes"]["opencv"] == pictures_and_layers
    assert one["crossing_bytes"]["gl"] > 0
    (row,) = section.tables[0].rows
    assert len(row) == len(section.tables[0].headings)
    assert record["renderer"] in section.text[0]


def test_layers_stay_in_their_textures_where_contexts_share(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(side, "RUNS", 1)
    _, ((stays,)) = side.side_by_side(["fast"], SMALL)
    monkeypatch.setattr(side, "shared", lambda: None)
    _, ((read_back,)) = side.side_by_side(["fast"], SMALL)
    layers = 3 * 160 * 90 * 4
    assert read_back.crossing_bytes["gl"] - stays.crossing_bytes["gl"] == 2 * layers  # down, and up again


def test_without_opengl_it_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    def nothing(*_: object) -> None:
        raise MissingPart("no OpenGL without a screen")

    monkeypatch.setattr(side, "Painter", nothing)
    section, record = backends_section(["fast"], SMALL)
    assert "no OpenGL" in section.text[0]
    assert record == {"missing": "no OpenGL without a screen"}
