"""Tests that the page is complete and self-contained, even for a calibration with only a matrix."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from calib.commands import app
from runtime.errors import InputError
from runtime.support.picture_file import read_image
from tests.calib.camera import measured, write_pairs
from tests.calls import answered
from tests.eyes.test_calibration_file import PUBLISHED


@pytest.fixture
def calibration(tmp_path: Path) -> Path:
    sensor = measured(sigma_m=0.003)
    sensor[5] += 0.3
    path = tmp_path / "c.toml"
    answered(app, "solve", "--pairs", write_pairs(tmp_path, sensor), "--out", path)
    return path


def test_the_page_holds_numbers_and_pictures_and_needs_nothing_else(tmp_path: Path, calibration: Path) -> None:
    out = tmp_path / "deep" / "report"
    told = answered(app, "report", calibration, "--out", out)
    assert told["points"] == 27 and told["rejected"] == 1
    page = (out / "index.html").read_text()
    assert page.count("data:image/png;base64,") == 1 and not re.search(r"(src|href)=\"(?!data:|#)", page)
    assert all(text in page for text in ("rms_mm", "robust", "condition", "eye_error_mm", "line 7", "rejected"))
    assert read_image(out / "residuals.png").std() > 5


def test_the_published_prototype_is_reported_without_its_points(tmp_path: Path) -> None:
    path = tmp_path / "published.toml"
    path.write_text(PUBLISHED)
    told = answered(app, "report", path, "--out", tmp_path / "r")
    assert told["scale"] == pytest.approx(8.125, abs=1e-3)
    assert told["similarity_defect"] < 2e-6 and told["eye_error_mm"] is None
    page = (tmp_path / "r" / "index.html").read_text()
    assert "far from 1" in page and "contains no pairs" in page


@pytest.mark.parametrize(("sensor_m", "used", "told"), [
    ("[1, 2]", "true", "data"), ("[1, 2, 3]", "true, true", "data.*differ in length"),
    ("[1, 2, 3]", "false", "data.*true for no pair"), ("[1, 2, nan]", "true", "data"),
])  # fmt: skip
def test_spoiled_points_are_refused_and_nothing_is_written(tmp_path: Path, sensor_m: str, used: str, told: str) -> None:
    path = tmp_path / "c.toml"
    data = f"sensor_m = [{sensor_m}]\nstack_m = [[1, 2, 3]]\nused = [{used}]\nnames = ['a']\n"
    path.write_text(f"{PUBLISHED}[data]\n{data}")
    with pytest.raises(InputError, match=told):
        answered(app, "report", path, "--out", tmp_path / "r")
    assert not (tmp_path / "r").exists()
