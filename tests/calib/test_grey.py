"""Grey curves: fitted from few luminances, inverted, and read by the panels."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from calib.commands import app
from calib.grey import fit_grey_curve, read_series
from runtime.errors import InputError
from runtime.panels.lut import measured_curve

run = CliRunner()


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


@pytest.mark.parametrize(
    ("grey", "told", "why"),
    [
        ([0, 0.5, 1], [0, 1, 2], "at least 4"),
        ([0, 0.3, 0.5, 0.6], [0, 1, 2, 3], "from black to full white"),
        ([0, 0.3, 0.6, 1], [3, 2, 1, 0], "not brighter"),
        ([0, 0.3, 0.6, 1], [1, 1, 1, 1], "not brighter"),
    ],
)
def test_a_series_that_tells_nothing_is_refused(grey: list[float], told: list[int], why: str) -> None:
    with pytest.raises(ValueError, match=why):
        fit_grey_curve(np.array(grey, dtype=float), np.array(told, dtype=float))


def test_the_panels_read_the_lut_that_is_written(tmp_path: Path) -> None:
    grey = np.linspace(0, 255, 17).round()
    rows = [f"{g:.0f}," + ",".join(f"{luminance((g / 255) ** gamma):.4f}" for gamma in (1.0, 1.5, 2.0)) for g in grey]
    (tmp_path / "series.csv").write_text("grey,red,green,blue\n" + "\n".join(rows) + "\n")
    out = tmp_path / "deep" / "lut.csv"
    result = run.invoke(app, ["grey", "--series", str(tmp_path / "series.csv"), "--out", str(out), "--json"])
    assert result.exit_code == 0, result.output
    table = measured_curve(out)
    phase = np.linspace(0, 1, 256)
    for channel, gamma in enumerate((1.0, 1.5, 2.0)):
        np.testing.assert_allclose(table[:, channel], phase ** (1 / gamma), atol=0.02)
    told = json.loads(result.stdout)
    assert set(told["channels"]) == {"red", "green", "blue"}


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("", "grey: column is missing"),
        ("grey,red\n", "luminance: column is missing"),
        ("grey,luminance\n", "there are no rows"),
        ("grey,luminance\n0,x\n1,\n", "line 2, luminance: is not a number: x; line 3, luminance: is missing"),
        ("grey,luminance\n0,1\n300,2\n", "grey: must lie"),
        ("grey,luminance\n0,-1\n1,2\n", "luminance: must not be negative"),
    ],
)
def test_a_wrong_series_is_refused_with_its_place(tmp_path: Path, text: str, wanted: str) -> None:
    (tmp_path / "s.csv").write_text(text)
    with pytest.raises(InputError, match=wanted):
        read_series(tmp_path / "s.csv")
