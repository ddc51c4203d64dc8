"""Tests `calibrate panels` from simulated photographs to the configuration."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from calib.board import PER_PANEL, board
from calib.commands import app
from calib.detect_marks import find_marks
from calib.placed import PlacedPanel, true_from_ideal_seen
from calib.viewpoints import viewing_place_m
from runtime.config import Settings, StackGeometry, load_settings
from runtime.errors import InputError
from runtime.optics.stack import PanelStack
from tests.calib.simulator import error_over_panel_px, in_frame_of, misplaced, simulated_photographs
from tests.calls import answered, invoked, refusal

STACK = StackGeometry().stack()
EYE = viewing_place_m(Settings().calibration)
CONFIG = '# kept\n[[output.panels]]\nconnector = "A"\n[[output.panels]]\nconnector = "B"\n[[output.panels]]\n'


def request(photos: Path, out: Path, config: Path) -> tuple[object, ...]:
    return ("panels", "--photos", photos, "--out", out, "--config", config, "--write")


@pytest.fixture(scope="module")
def truth() -> tuple[PlacedPanel, ...]:
    return misplaced(STACK, shift_m=0.002, turn_deg=1.0, gap_m=0.002, random=np.random.default_rng(2))


@pytest.fixture(scope="module")
def pictures(truth: tuple[PlacedPanel, PlacedPanel, PlacedPanel]) -> list[np.ndarray]:
    return simulated_photographs(STACK, truth, count=7, random=np.random.default_rng(3))


@pytest.fixture
def photos(tmp_path: Path, pictures: list[np.ndarray]) -> Path:
    folder = tmp_path / "photos"
    folder.mkdir()
    for number, picture in enumerate(pictures):
        cv2.imwrite(str(folder / f"{number + 1}.bmp"), picture)  # quickly
    return folder


def half_covered(picture: np.ndarray) -> np.ndarray:
    covered = picture.copy()
    covered[:, : round(picture.shape[1] * 0.55)] = 40
    return covered


@pytest.mark.parametrize("stack", [
    STACK, PanelStack(0.5, 0.28, (-0.03, 0.03), 3840, 2160), PanelStack(0.3, 0.2, (-0.04, 0.0, 0.02, 0.05), 1280, 800),
])  # fmt: skip
def test_a_camera_square_to_a_bare_panel_reads_every_mark_exactly(stack: PanelStack) -> None:
    for index in range(stack.count):
        picture = cv2.copyMakeBorder(board(stack, index), 40, 40, 40, 40, cv2.BORDER_CONSTANT)
        seen = find_marks(cv2.GaussianBlur(picture, (0, 0), 0.8), stack, name="")
        assert seen.marks[index] == sum(seen.marks) == PER_PANEL
        # Pixel centres are half-integers on a panel and integers in a picture.
        assert np.abs(seen.image_px - 40 + 0.5 - seen.panel_px).max() < 0.1


def test_photographs_register_the_panels_in_the_configuration(
    tmp_path: Path, photos: Path, truth: tuple[PlacedPanel, PlacedPanel, PlacedPanel]
) -> None:
    config = tmp_path / "c.toml"
    config.write_text(CONFIG)
    told = answered(app, *request(photos, tmp_path / "r", config))
    settings = load_settings(config)
    assert config.read_text().startswith("# kept")
    assert [panel.connector for panel in settings.output.panels] == ["A", "B", ""]
    stack = settings.stack.stack()
    true = in_frame_of(truth, reference=1, reference_x_m=0.0)
    assert np.abs(np.diff(stack.x_m) - np.diff([panel.axis_x_m for panel in true])).max() < 0.2e-3
    for index, panel in enumerate(settings.output.panels):
        expected = true_from_ideal_seen(true[index], EYE, stack, index)
        error = error_over_panel_px(np.array(panel.homography), expected, STACK)
        assert np.sqrt((error**2).mean()) < 0.1 and error.max() < 0.3
    assert Path(told["kept_version"]).read_text() == CONFIG
    assert json.loads((tmp_path / "r" / "registration.json").read_text())["used"] == 7


@pytest.mark.parametrize(("spoil", "why"), [
    (lambda picture: cv2.GaussianBlur(picture, (0, 0), 4.0), "blurred"), (half_covered, "keep the whole panel in view"),
    (lambda picture: picture[:, ::-1], "is mirrored"), (lambda picture: np.full_like(picture, 30), "shows no marks"),
])  # fmt: skip
def test_photographs_that_cannot_be_used_are_named_and_nothing_is_written(
    tmp_path: Path, photos: Path, pictures: list[np.ndarray], spoil: Callable[..., Any], why: str
) -> None:
    config = tmp_path / "c.toml"
    config.write_text(CONFIG)
    for number in (1, 3, 5):
        cv2.imwrite(str(photos / f"{number}.bmp"), np.ascontiguousarray(spoil(pictures[number - 1])))
    text = refusal(answered, app, *request(photos, tmp_path / "r", config))
    assert all(part in text for part in ("4 of 7 photographs are usable", "1.bmp", "3.bmp", "5.bmp", why))
    assert "\n" not in text and config.read_text() == CONFIG and not (tmp_path / "r").exists()


def test_a_configuration_that_cannot_be_updated_leaves_no_registration(tmp_path: Path, photos: Path) -> None:
    config = tmp_path / f"{'c' * 250}.toml"  # has no room for the number of a kept version
    config.write_text(CONFIG)
    assert "cannot be written" in refusal(answered, app, *request(photos, tmp_path / "r", config))
    assert config.read_text() == CONFIG and not (tmp_path / "r").exists()


WRONG = [
    "charts --out x --config no-such-file.toml", "grey --out l.csv --photos none --panel 1",
    "grey --photos . --panel 1", "grey --panel 3 --show", "grey --panel 1 --out c.png", "grey --panel 1",
    "panels", "panels --photos .", "panels --out r", "panels --out r --photos . --show",
    "panels --out r --photos none", "panels --out r --photos .", "panels --out r --photos . --write",
]  # fmt: skip


@pytest.mark.parametrize("request_line", WRONG)
def test_wrong_requests_are_refused_and_leave_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request_line: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert isinstance(invoked(app, *request_line.split()).exception, InputError)
    assert list(tmp_path.iterdir()) == []
