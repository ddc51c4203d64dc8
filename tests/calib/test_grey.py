"""Grey curves: from the greys of a chart to the LUT that the panels read."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from calib.grey_chart import GREYS, write_lut
from runtime.optics.malus import intensity_from_phase
from runtime.panels.lut import measured_curve

CURVES = {
    "bare panel, straight": lambda g: g,
    "bare panel, gamma": lambda g: g**1.8,
    "monitor's tone curve": lambda g: np.arcsin(np.sqrt(g**2.2)) * 2 / np.pi,
    "s-shaped": lambda g: (1 - np.cos(np.pi * g)) / 2,
}


@pytest.mark.parametrize("curve", CURVES.values(), ids=CURVES)
def test_the_lut_that_the_panels_read_undoes_the_curve_and_ascends(
    curve: Callable[..., np.ndarray], tmp_path: Path
) -> None:
    write_lut(tmp_path / "deep" / "lut.csv", intensity_from_phase(curve(np.array(GREYS) / 255)))
    lut = measured_curve(tmp_path / "deep" / "lut.csv").astype(float)
    assert (np.diff(lut, axis=0) >= 0).all() and (lut[0] == 0).all() and (lut[-1] == 1).all()
    wanted = intensity_from_phase(np.linspace(0, 1, 256))
    assert np.abs(intensity_from_phase(curve(lut[:, 1])) - wanted).max() < 0.005


def test_greys_that_scatter_ascend_in_the_lut(tmp_path: Path) -> None:
    even = np.linspace(0, 1, 13)
    write_lut(tmp_path / "lut.csv", np.clip(even + 0.05 * np.sin(7 * np.arange(13)) * even * (1 - even), 0, 1))
    assert (np.diff(measured_curve(tmp_path / "lut.csv"), axis=0) >= 0).all()
