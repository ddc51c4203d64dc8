"""Tests that grey follows phase by a gamma or a measured curve per colour."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from runtime.errors import InputError
from runtime.panels.lut import curve, measured_curve


@pytest.mark.parametrize("gamma", [1.0, 2.2])
def test_a_gamma_undoes_the_panels_own(gamma: float) -> None:
    grey = curve(lut="", gamma=gamma)
    assert grey.shape == (256, 3) and np.allclose(grey**gamma, np.linspace(0, 1, 256)[:, None], atol=1e-6)


def test_a_measured_curve_is_interpolated_per_channel_or_serves_all(tmp_path: Path) -> None:
    path = tmp_path / "curve.csv"
    path.write_text("phase,red,green,blue\n0,0,0,0\n0.5,0.25,0.5,0.75\n1,1,1,1\n")
    assert curve(lut=str(path), gamma=1.0)[64] == pytest.approx(np.array([0.5, 1.0, 1.5]) * 64 / 255, abs=1e-6)
    path.write_text("# measured\nphase,grey\n0,0.1\n1,0.9\n")
    assert curve(lut=str(path), gamma=1.0)[[0, 255]] == pytest.approx(np.array([[0.1] * 3, [0.9] * 3]))


@pytest.mark.parametrize(
    ("text", "field"),
    [
        ("", "columns"),
        ("a,b\n0,0\n1,1\n", "columns"),
        ("phase,grey\n0,0\n", "phase"),
        ("phase,grey\n0,0\n0,1\n", "phase"),
        ("phase,grey\n0,0\n1,1.5\n", "values"),
        ("phase,grey\n-0.1,0\n1,1\n", "values"),
        ("phase,grey\n0,-0.1\n1,1\n", "values"),
        ("phase,grey\n0,0\n1,nan\n", "values"),
        ("phase,grey\n0,0\n1,x\n", "rows"),
        ("phase,grey\n0,0\n1\n", "rows"),
    ],
)
def test_a_wrong_curve_is_refused_by_file_and_field(tmp_path: Path, text: str, field: str) -> None:
    path = tmp_path / "curve.csv"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        curve(lut=str(path), gamma=1.0)
    assert caught.value.source == str(path)
    assert caught.value.field == field


@pytest.mark.parametrize(
    "text",
    [
        "phase;grey\n0;0\n0,5;0,25\n1;1\n",
        "phase,grey\n\n0,0\n0.5,0.25\n1,1\n",
        "phase\tgrey\n0\t0\n0,5\t0,25\n1\t1\n",
        "sep=;\nphase;grey\n# measured; by hand\n0;0\n0,5;0,25\n1;1\n",
        "\ufeffphase;grey\n0;0\n0.5;0.25\n1;1\n",
    ],
)
def test_a_table_from_a_german_spreadsheet_is_read(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.csv").write_text(text, encoding="utf-8")
    (tmp_path / "b.csv").write_text("phase,grey\n0,0\n0.5,0.25\n1,1\n")
    assert np.array_equal(measured_curve(tmp_path / "a.csv"), measured_curve(tmp_path / "b.csv"))
