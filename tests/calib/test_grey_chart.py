"""Compares grey curves measured with a simulated panel and camera with the panel's actual curve."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from calib.commands import app
from calib.grey_chart import GREYS, AngleRange, grey_charts, histograms, measure, write_lut
from runtime.config import StackGeometry
from runtime.panels.lut import measured_curve
from tests.calib.simulator import Camera, camera_from_stack, ideal_panel, photograph
from tests.calls import answered

STACK = StackGeometry().stack()
PANEL = 2


def phase_of(grey: np.ndarray) -> np.ndarray:
    """The simulated panel's own curve: an s, with a gamma."""
    return (1 - np.cos(np.pi * grey**1.4)) / 2


def photographs(curve: Callable[..., Any], *, count: int = 2, gain: float = 0.85) -> list[np.ndarray]:
    phases = np.rint(255 * curve(grey_charts(STACK, PANEL) / 255)).astype(np.uint8)
    panels = [ideal_panel(STACK, index) for index in range(3)]
    camera, random = Camera(2800, 2100, 2130.0, gain=gain, dark=0.004), np.random.default_rng(1)
    places = np.array([[0.75, 0.0, 0.0], [0.8, 0.1, 0.05]])[:count]
    poses = [camera_from_stack(place, towards_m=np.zeros(3)) for place in places]
    return [photograph(phases, panels, STACK, camera, pose, random) for pose in poses]


@pytest.fixture(scope="module")
def pictures() -> list[np.ndarray]:
    return photographs(phase_of)


def measured_from(folder: Path, pictures: list[np.ndarray]) -> np.ndarray:
    """The curve (256, 3) that the command measures from photographs."""
    for number, picture in enumerate(pictures):
        cv2.imwrite(str(folder / f"{number}.png"), picture)
    answered(app, "grey", "--photos", folder, "--panel", PANEL, "--out", folder / "lut.csv")
    return measured_curve(folder / "lut.csv").astype(float)


def test_two_photographs_tell_a_panels_curve_without_knowing_the_cameras(
    tmp_path: Path, pictures: list[np.ndarray]
) -> None:
    lut = measured_from(tmp_path, pictures)[:, 1]
    wanted = np.linspace(0, 1, 256)
    shown = np.sin(np.pi / 2 * phase_of(lut)) ** 2
    assert np.abs(shown - np.sin(np.pi / 2 * wanted) ** 2).max() < 0.03


def test_colour_photographs_tell_each_channels_curve(tmp_path: Path, pictures: list[np.ndarray]) -> None:
    def blue_phase_of(grey: np.ndarray) -> np.ndarray:
        return grey**0.7

    other = photographs(blue_phase_of)
    blue_green_red = [np.dstack([blue, green, green]) for green, blue in zip(pictures, other, strict=True)]
    lut, wanted = measured_from(tmp_path, blue_green_red), np.sin(np.pi / 2 * np.linspace(0, 1, 256)) ** 2
    for channel, curve in enumerate((phase_of, phase_of, blue_phase_of)):
        assert np.abs(np.sin(np.pi / 2 * curve(lut[:, channel])) ** 2 - wanted).max() < 0.03


def test_a_curve_that_falls_is_told_and_not_swallowed() -> None:
    falling = photographs(lambda grey: np.where(grey < 0.6, grey, grey - 0.25))
    with pytest.raises(match=r"grey 170 is darker than grey 149"):
        measure([histograms(picture, STACK, PANEL, source="p")[0] for picture in falling], STACK, PANEL, source="p")


@pytest.mark.parametrize(("gain", "why"), [(1.25, "overexposed"), (0.02, "marks|too dark")])
def test_a_wrong_exposure_is_told(gain: float, why: str) -> None:
    (picture,) = photographs(phase_of, count=1, gain=gain)
    with pytest.raises(match=why):
        histograms(picture, STACK, PANEL, source="p")


def test_a_panel_whose_angles_are_known_turns_by_the_angles_asked_for(tmp_path: Path) -> None:
    black_deg, white_deg = 4.0, 78.0

    def turned_deg(grey: np.ndarray) -> np.ndarray:
        return black_deg + (white_deg - black_deg) * phase_of(grey)

    light = np.sin(np.radians(turned_deg(np.array(GREYS) / 255))) ** 2
    write_lut(tmp_path / "lut.csv", (light - light[0]) / (light[-1] - light[0]), AngleRange(black_deg, white_deg))
    asked_deg = np.linspace(0, 90, 256)
    shown_deg = turned_deg(measured_curve(tmp_path / "lut.csv")[:, 1].astype(float))
    assert np.abs(shown_deg - asked_deg.clip(black_deg, white_deg)).max() < 0.5
