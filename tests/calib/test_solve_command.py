"""`calibrate solve`: a file that the runtime loads, or one clear refusal and nothing written."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from calib.commands import app
from calib.solution import METHODS
from runtime.errors import InputError
from runtime.eyes.calibration import load_calibration
from runtime.eyes.demo_geometry import demo_stack_from_sensor

run = CliRunner()


def solve(pairs: Path, out: Path, *options: str) -> dict:
    result = run.invoke(app, ["solve", "--pairs", str(pairs), "--out", str(out), "--json", *options])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


def refusal(pairs: Path, tmp_path: Path, *options: str) -> str:
    before = sorted(tmp_path.iterdir())
    with pytest.raises(InputError) as caught:
        solve(pairs, tmp_path / "refused.toml", *options)
    assert sorted(tmp_path.iterdir()) == before, "after an error nothing new is left"
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_the_runtime_loads_what_solve_writes(
    tmp_path: Path, measured: Callable[..., np.ndarray], known_m: np.ndarray, write_pairs: Callable[..., Path]
) -> None:
    out = tmp_path / "deep" / "calibration.toml"
    told = solve(write_pairs(measured(sigma_m=0.003), known_m), out)
    loaded = load_calibration(out)
    np.testing.assert_array_equal(loaded.stack_from_sensor, told["stack_from_sensor"])
    np.testing.assert_allclose(loaded.stack_from_sensor, demo_stack_from_sensor(), atol=0.02)
    assert loaded.method == told["method"] == "fixed-scale"
    assert loaded.pairs == 27
    assert loaded.residuals is not None and loaded.residuals.rms_m * 1e3 == pytest.approx(told["rms_mm"])
    assert loaded.position_error_m([[0.5, 0.0, 0.0]])[0] < 0.003
    assert loaded.date.endswith("+00:00")


@pytest.mark.parametrize("method", METHODS)
def test_every_method_can_be_asked_for(
    tmp_path: Path,
    measured: Callable[..., np.ndarray],
    known_m: np.ndarray,
    write_pairs: Callable[..., Path],
    method: str,
) -> None:
    told = solve(write_pairs(measured(sigma_m=0.002), known_m), tmp_path / "c.toml", "--method", method)
    assert told["method"] == method
    assert {row["method"] for row in told["methods"]} == set(METHODS)
    assert load_calibration(tmp_path / "c.toml").method == method


def test_the_error_figures_are_told(
    tmp_path: Path, measured: Callable[..., np.ndarray], known_m: np.ndarray, write_pairs: Callable[..., Path]
) -> None:
    told = solve(write_pairs(measured(sigma_m=0.003), known_m), tmp_path / "c.toml")
    assert 0 < told["rms_mm"] < told["max_mm"] < 20
    assert told["leave_one_out_mm"] > told["rms_mm"]
    assert len(told["axis_rms_mm"]) == 3
    assert 1 < told["condition"] < 3


def test_the_sensors_serial_travels_from_the_pairs_to_the_runtimes_check(
    tmp_path: Path, measured: Callable[..., np.ndarray], known_m: np.ndarray, write_pairs: Callable[..., Path]
) -> None:
    path = write_pairs(measured(), known_m)
    lines = path.read_text().splitlines()
    path.write_text("\n".join([lines[0] + ",sensor_serial", *[line + ",A1" for line in lines[1:]]]))
    solve(path, tmp_path / "c.toml")
    assert "A1" in load_calibration(tmp_path / "c.toml").serial_warning("B2")


def test_outliers_are_named(
    tmp_path: Path, measured: Callable[..., np.ndarray], known_m: np.ndarray, write_pairs: Callable[..., Path]
) -> None:
    sensor = measured(sigma_m=0.003)
    sensor[[4, 20]] += [0.2, -0.3, 0.1]
    told = solve(write_pairs(sensor, known_m), tmp_path / "c.toml")
    assert told["method"] == "robust"
    assert told["outliers"] == ["line 6", "line 22"]
    assert any("line 6, line 22: rejected" in warning for warning in told["warnings"])


def test_one_pair_beyond_the_seeds_five_centimetres_is_named(
    tmp_path: Path, measured: Callable[..., np.ndarray], known_m: np.ndarray, write_pairs: Callable[..., Path]
) -> None:
    sensor = measured(sigma_m=0.001)
    sensor[3] += [0.0, 0.09, 0.0]
    told = solve(write_pairs(sensor, known_m), tmp_path / "c.toml", "--method", "inverse")
    assert any("line 5: residual beyond 50 mm" in warning for warning in told["warnings"])


def test_units_that_together_make_a_scale_that_no_calibration_has_are_refused(
    tmp_path: Path, measured: Callable[..., np.ndarray], known_m: np.ndarray, write_pairs: Callable[..., Path]
) -> None:
    units = ("--sensor-unit", "1e6", "--stack-unit", "1e-6")
    assert "stack_from_sensor: has scale 1e-12" in refusal(write_pairs(measured(), known_m), tmp_path, *units)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_fewer_than_three_pairs_are_refused(
    tmp_path: Path,
    measured: Callable[..., np.ndarray],
    known_m: np.ndarray,
    write_pairs: Callable[..., Path],
    count: int,
) -> None:
    assert "at least 3" in refusal(write_pairs(measured()[:count], known_m[:count]), tmp_path)


@pytest.mark.parametrize("count", [3, 4, 5, 6])
def test_three_pairs_and_more_are_enough(
    tmp_path: Path,
    measured: Callable[..., np.ndarray],
    known_m: np.ndarray,
    write_pairs: Callable[..., Path],
    count: int,
) -> None:
    some = [0, 8, 22, 13, 4, 18][:count]
    solve(write_pairs(measured()[some], known_m[some]), tmp_path / "c.toml")
    np.testing.assert_allclose(
        load_calibration(tmp_path / "c.toml").stack_from_sensor, demo_stack_from_sensor(), atol=1e-9
    )


def test_coincident_points_are_refused(tmp_path: Path, known_m: np.ndarray, write_pairs: Callable[..., Path]) -> None:
    assert "coincide" in refusal(write_pairs(np.ones((27, 3)), known_m), tmp_path)


def test_viewpoints_all_but_in_one_place_are_refused(
    tmp_path: Path, measured: Callable[..., np.ndarray], known_m: np.ndarray, write_pairs: Callable[..., Path]
) -> None:
    close = known_m.mean(0) + 1e-3 * (known_m - known_m.mean(0))
    assert "do not determine" in refusal(write_pairs(measured(close), close), tmp_path)


def test_collinear_points_are_refused(
    tmp_path: Path, measured: Callable[..., np.ndarray], write_pairs: Callable[..., Path]
) -> None:
    line = np.outer(np.linspace(0.3, 0.9, 9), [1.0, 0.1, 0.2])
    assert "on one line" in refusal(write_pairs(measured(line), line), tmp_path)


@pytest.mark.parametrize("aspect", [1e-2, 1e-3, 1e-5])
def test_nearly_collinear_points_are_refused_with_what_they_would_cost(
    tmp_path: Path, measured: Callable[..., np.ndarray], write_pairs: Callable[..., Path], aspect: float
) -> None:
    random = np.random.default_rng(0)
    line = np.outer(np.linspace(0.4, 0.6, 9), [1.0, 0.0, 0.0]) + 0.1 * aspect * random.normal(size=(9, 3))
    message = refusal(write_pairs(measured(line), line), tmp_path)
    assert "do not determine" in message
    assert "condition" in message


def test_coplanar_points_are_fine_and_said_to_be(
    tmp_path: Path, measured: Callable[..., np.ndarray], known_m: np.ndarray, write_pairs: Callable[..., Path]
) -> None:
    flat = known_m * [1.0, 1.0, 0.0]
    told = solve(write_pairs(measured(flat), flat), tmp_path / "c.toml")
    assert any("one plane" in warning for warning in told["warnings"])
    np.testing.assert_allclose(told["stack_from_sensor"], demo_stack_from_sensor(), atol=1e-9)


@pytest.mark.parametrize("sigma_m", [0.0, 0.01])
@pytest.mark.parametrize("axis", range(3))
def test_mirrored_data_are_refused(
    tmp_path: Path,
    measured: Callable[..., np.ndarray],
    known_m: np.ndarray,
    write_pairs: Callable[..., Path],
    axis: int,
    sigma_m: float,
) -> None:
    mirror = np.ones(3)
    mirror[axis] = -1.0
    assert "mirror" in refusal(write_pairs(measured(sigma_m=sigma_m) * mirror, known_m), tmp_path)


@pytest.mark.parametrize(("scale", "option"), [(1000.0, "--stack-unit"), (0.001, "--sensor-unit")])
def test_millimetres_on_one_side_are_refused_and_can_be_declared(
    tmp_path: Path,
    measured: Callable[..., np.ndarray],
    known_m: np.ndarray,
    write_pairs: Callable[..., Path],
    scale: float,
    option: str,
) -> None:
    mixed = (measured(scale=scale), known_m) if scale < 1 else (measured(), known_m * 1000)
    path = write_pairs(*mixed)
    message = refusal(path, tmp_path)
    assert "units are mixed" in message
    assert option in message
    solve(path, tmp_path / "c.toml", option, "0.001")
    np.testing.assert_allclose(
        load_calibration(tmp_path / "c.toml").stack_from_sensor, demo_stack_from_sensor(), atol=1e-9
    )


def test_repeated_rows_are_left_out_and_named(
    tmp_path: Path, measured: Callable[..., np.ndarray], known_m: np.ndarray, write_pairs: Callable[..., Path]
) -> None:
    twice = [*range(27), 3]
    told = solve(write_pairs(measured(sigma_m=0.001)[twice], known_m[twice]), tmp_path / "c.toml")
    assert told["pairs"] == 27
    assert any("line 29: repeats" in warning for warning in told["warnings"])


def test_nan_rows_are_refused_with_their_line(
    tmp_path: Path, measured: Callable[..., np.ndarray], known_m: np.ndarray, write_pairs: Callable[..., Path]
) -> None:
    sensor = measured()
    sensor[7, 1] = np.nan
    assert "line 9, sensor_y: is not finite" in refusal(write_pairs(sensor, known_m), tmp_path)


def test_pairs_that_do_not_fit_are_refused_with_a_hint(
    tmp_path: Path, measured: Callable[..., np.ndarray], known_m: np.ndarray, write_pairs: Callable[..., Path]
) -> None:
    sensor = measured()
    sensor[::5] += [0.2, 0.1, -0.2]
    message = refusal(write_pairs(sensor, known_m), tmp_path, "--method", "seed")
    assert "more than 50 mm" in message
    assert "robust" in message


def test_pairs_that_do_not_belong_together_are_refused(
    tmp_path: Path, known_m: np.ndarray, write_pairs: Callable[..., Path]
) -> None:
    shuffled = np.random.default_rng(3).permutation(known_m)
    refusal(write_pairs(shuffled, known_m), tmp_path)


def test_an_unknown_method_is_refused(
    tmp_path: Path, measured: Callable[..., np.ndarray], known_m: np.ndarray, write_pairs: Callable[..., Path]
) -> None:
    assert "--method" in refusal(write_pairs(measured(), known_m), tmp_path, "--method", "magic")


def test_past_versions_are_kept_and_come_back(
    tmp_path: Path, measured: Callable[..., np.ndarray], known_m: np.ndarray, write_pairs: Callable[..., Path]
) -> None:
    out = tmp_path / "c.toml"
    texts = []
    for seed in range(3):
        solve(write_pairs(measured(sigma_m=0.002, seed=seed), known_m), out)
        texts.append(out.read_text())
    for expected in (texts[1], texts[0]):
        replaced = out.read_text()
        assert run.invoke(app, ["solve", "--out", str(out), "--rollback"]).exit_code == 0
        assert out.read_text() == expected
        assert (tmp_path / "c.undone.toml").read_text() == replaced
    result = run.invoke(app, ["solve", "--out", str(out), "--rollback"])
    assert isinstance(result.exception, InputError)
    assert out.read_text() == texts[0]


def test_a_broken_past_version_is_not_put_back(
    tmp_path: Path, measured: Callable[..., np.ndarray], known_m: np.ndarray, write_pairs: Callable[..., Path]
) -> None:
    out = tmp_path / "c.toml"
    for seed in range(2):
        solve(write_pairs(measured(sigma_m=0.002, seed=seed), known_m), out)
    good = out.read_text()
    (tmp_path / "c.1.toml").write_text("broken")
    assert isinstance(run.invoke(app, ["solve", "--out", str(out), "--rollback"]).exception, InputError)
    assert out.read_text() == good
