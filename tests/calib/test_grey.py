"""Grey curves: fitted from few luminances, inverted, and read by the panels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calib.grey import fit_grey_curve, fit_lut
from runtime.panels.lut import measured_curve


def luminance(phase: np.ndarray, *, dark: float = 0.5, white: float = 200.0) -> np.ndarray:
    return dark + (white - dark) * np.sin(np.pi / 2 * phase) ** 2


CURVES = {
    "bare panel, straight": lambda g: g,
    "bare panel, gamma": lambda g: g**1.8,
    "monitor's tone curve": lambda g: np.arcsin(np.sqrt(g**2.2)) * 2 / np.pi,
    "s-shaped": lambda g: (1 - np.cos(np.pi * g)) / 2,
}


@pytest.mark.parametrize("name", CURVES)
@pytest.mark.parametrize("levels", [9, 17])
def test_a_short_series_gives_the_curve(name: str, levels: int) -> None:
    grey = np.linspace(0, 1, levels)
    found = fit_grey_curve(grey, luminance(CURVES[name](grey)))
    fine = np.linspace(0, 1, 301)
    assert np.abs(found.phase(fine) - CURVES[name](fine)).max() < 0.005
    assert found.residual < 0.001


@settings(deadline=None, max_examples=10)
@given(st.floats(0.5, 3.0), st.floats(0, 5), st.floats(50, 500), st.integers(5, 20))
def test_the_inverse_undoes_the_curve_and_ascends(gamma: float, dark: float, white: float, levels: int) -> None:
    grey = np.linspace(0, 1, levels)
    found = fit_grey_curve(grey, luminance(grey**gamma, dark=dark, white=white))
    wanted = np.linspace(0, 1, 101)
    table = found.grey(wanted)
    assert (np.diff(table) >= 0).all()
    assert table[0] == pytest.approx(0, abs=1e-6)
    assert table[-1] == pytest.approx(1, abs=1e-6)
    np.testing.assert_allclose(found.phase(table), wanted, atol=1e-3)


@given(st.lists(st.floats(0, 100), min_size=6, max_size=6))
@settings(deadline=None, max_examples=4)
def test_whatever_was_measured_the_curve_ascends(values: list[float]) -> None:
    told = np.array([0.0, *values, 100.0])
    found = fit_grey_curve(np.linspace(0, 1, 8), told)
    assert (np.diff(found.phase(np.linspace(0, 1, 200))) >= -1e-12).all()


def test_the_panels_read_the_lut_that_is_written(tmp_path: Path) -> None:
    grey = np.linspace(0, 1, 13)
    fit_lut(tmp_path / "deep" / "lut.csv", grey, luminance(grey**1.5))
    table = measured_curve(tmp_path / "deep" / "lut.csv")
    np.testing.assert_allclose(table, np.repeat(np.linspace(0, 1, 256)[:, None] ** (1 / 1.5), 3, axis=1), atol=0.02)
