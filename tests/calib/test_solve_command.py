"""Tests that `calibrate solve` writes a file that the runtime loads, or refuses in one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calib.commands import app
from runtime.eyes.calibration import demo_stack_from_sensor, load_calibration
from tests.calib.camera import KNOWN_M, measured, write_pairs
from tests.calls import answered, refusal


def solve(pairs: Path, out: Path, *options: str) -> dict:
    told: dict = answered(app, "solve", "--pairs", pairs, "--out", out, *options)
    return told


def refused(pairs: Path, tmp_path: Path, *options: str) -> str:
    before = sorted(tmp_path.iterdir())
    message = refusal(solve, pairs, tmp_path / "refused.toml", *options)
    assert sorted(tmp_path.iterdir()) == before, "after an error nothing new is left"
    return message


def test_the_runtime_loads_what_solve_writes(tmp_path: Path) -> None:
    out = tmp_path / "deep" / "calibration.toml"
    told = solve(write_pairs(tmp_path, measured(sigma_m=0.003)), out)
    loaded = load_calibration(out)
    np.testing.assert_array_equal(loaded.stack_from_sensor, told["stack_from_sensor"])
    np.testing.assert_allclose(loaded.stack_from_sensor, demo_stack_from_sensor(), atol=0.02)
    assert loaded.file.method == told["method"] == "fixed-scale"
    assert loaded.file.residuals is not None and loaded.file.residuals.rms_m * 1e3 == pytest.approx(told["rms_mm"])
    assert loaded.position_error_m([[0.5, 0.0, 0.0]])[0] < 0.003 and loaded.file.date.endswith("+00:00")


def test_the_sensors_serial_travels_from_the_pairs_to_the_runtimes_check(tmp_path: Path) -> None:
    path = write_pairs(tmp_path, measured())
    lines = path.read_text().splitlines()
    path.write_text("\n".join([lines[0] + ",sensor_serial", *[line + ",A1" for line in lines[1:]]]))
    solve(path, tmp_path / "c.toml")
    assert "A1" in load_calibration(tmp_path / "c.toml").serial_warning("B2")


@pytest.mark.parametrize("count", [3, 4, 5, 6])
def test_three_pairs_and_more_are_enough(tmp_path: Path, count: int) -> None:
    some = [0, 8, 22, 13, 4, 18][:count]
    solve(write_pairs(tmp_path, measured()[some], KNOWN_M[some]), tmp_path / "c.toml")
    found = load_calibration(tmp_path / "c.toml").stack_from_sensor
    np.testing.assert_allclose(found, demo_stack_from_sensor(), atol=1e-9)


@pytest.mark.parametrize("aspect", [1e-2, 1e-3, 1e-5])
def test_nearly_collinear_points_are_refused_with_what_they_would_cost(tmp_path: Path, aspect: float) -> None:
    random = np.random.default_rng(0)
    line = np.outer(np.linspace(0.4, 0.6, 9), [1.0, 0.0, 0.0]) + 0.1 * aspect * random.normal(size=(9, 3))
    message = refused(write_pairs(tmp_path, measured(line), line), tmp_path)
    assert "do not determine" in message and "condition" in message


@pytest.mark.parametrize("sigma_m", [0.0, 0.01])
@pytest.mark.parametrize("axis", range(3))
def test_mirrored_data_are_refused(tmp_path: Path, axis: int, sigma_m: float) -> None:
    mirror = np.ones(3)
    mirror[axis] = -1.0
    assert "mirror" in refused(write_pairs(tmp_path, measured(sigma_m=sigma_m) * mirror), tmp_path)


@pytest.mark.parametrize(("scale", "side"), [(1000.0, "stack"), (0.001, "sensor")])
def test_millimetres_on_one_side_are_refused(tmp_path: Path, scale: float, side: str) -> None:
    mixed = (measured(scale=scale), KNOWN_M) if scale < 1 else (measured(), KNOWN_M * 1000)
    message = refused(write_pairs(tmp_path, *mixed), tmp_path)
    assert "must be in metres" in message and f"{side} appears to be in millimetres" in message


def test_pairs_that_do_not_fit_are_refused_with_a_hint(tmp_path: Path) -> None:
    sensor = measured()
    sensor[::5] += [0.2, 0.1, -0.2]
    message = refused(write_pairs(tmp_path, sensor), tmp_path, "--method", "seed")
    assert "but the limit is 50 mm" in message and "robust" in message
