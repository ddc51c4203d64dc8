"""Tests that a calibration file must contain a similarity in metres, with a positive determinant."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from runtime.eyes.calibration import load_calibration, position_jacobian, similarity_defect
from runtime.records import EyePoints
from tests.calls import refusal

PUBLISHED = """stack_from_sensor = [
    [0.699976, 2.09768, 7.81822, -1.90611], [8.09414, -0.276962, -0.650369, 0.166057],
    [0.0985957, 7.8446, -2.11359, 3.31142], [0, 0, 0, 1]]
"""
C, S = np.cos(np.deg2rad(10)), np.sin(np.deg2rad(10))
DEMO_TURN = np.array([[0.0, -S, C], [-1.0, 0.0, 0.0], [0.0, -C, -S]])


def similarity(scale: float = 1.0, away_m: float = 0.0) -> np.ndarray:
    matrix = np.diag([scale, scale, scale, 1.0])
    matrix[0, 3] = away_m
    return matrix


def toml(matrix: np.ndarray) -> str:
    return f"stack_from_sensor = {np.asarray(matrix).tolist()}\n"


def test_the_demo_camera_is_tilted_down_by_ten_degrees() -> None:
    calibration = load_calibration(None)
    np.testing.assert_array_equal(calibration.stack_from_sensor[:3, :3], DEMO_TURN)
    assert calibration.warnings == ()


def test_eyes_keep_their_confidence_and_their_separation() -> None:
    eyes = EyePoints(np.array([[0.03, -0.05, 0.6], [-0.03, -0.05, 0.6]]), np.array([0.9, 0.4]), completed="right")
    covariance = np.diag([1e-6, 4e-6, 9e-6])
    moved = [load_calibration(None).apply(one) for one in (eyes, replace(eyes, covariance_m2=covariance))]
    assert moved[0].covariance_m2 is None and moved[1].covariance_m2 is not None
    np.testing.assert_allclose(DEMO_TURN.T @ moved[1].covariance_m2 @ DEMO_TURN, covariance, atol=1e-18)
    for one in moved:
        assert one.completed == "right"
        np.testing.assert_array_equal(one.confidence, eyes.confidence)
        assert np.linalg.norm(one.eyes_m[0] - one.eyes_m[1]) == pytest.approx(0.06)
        assert one.eyes_m[0][1] < one.eyes_m[1][1], "the left eye is on the viewer's left"


def test_a_file_tells_all_that_it_holds(tmp_path: Path) -> None:
    file = tmp_path / "c.toml"
    spread = (np.diag([1.0, 2, 3, 4, 5, 6, 7]) * 1e-6).tolist()
    more = "pairs = 27  # what only a person reads is passed over\ncondition = 3.5\nresiduals.rms_m = 0.001\n"
    head = f'{toml(np.eye(4))}method = "robust"\ndate = 2026-11-21\nsensor_serial = "A1"\n'
    file.write_text(f"{head}{more}[covariance]\npivot_m = [0.5, 0.1, 0.2]\nmatrix = {spread}\n")
    told = load_calibration(file)
    assert (told.source, told.file.method, told.file.sensor_serial) == (str(file), "robust", "A1")
    assert told.file.residuals is not None and told.file.covariance is not None
    assert (str(told.file.date), told.file.condition, told.file.residuals.rms_m) == ("2026-11-21", 3.5, 0.001)
    assert told.file.covariance.pivot_m == (0.5, 0.1, 0.2)
    np.testing.assert_array_equal(told.file.covariance.matrix, spread)


def test_the_published_prototype_matrix_is_a_similarity_to_its_printed_digits(tmp_path: Path) -> None:
    file = tmp_path / "published.toml"
    file.write_text(PUBLISHED)
    calibration = load_calibration(file)
    assert calibration.scale == pytest.approx(8.125, abs=5e-4)
    assert similarity_defect(calibration.stack_from_sensor) < 2e-6
    assert "8.12" in calibration.warnings[0], "its units are its own: a person is told"


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        (toml(similarity(1e200)), "stack_from_sensor.0.0: Input should be less than or equal to 1000000000"),
        *((toml(similarity(scale, 1.0)), "must be about 1; check") for scale in (1e-200, 1e6, 1e-6, 4.9e-4, 2010.0)),
        *(
            (toml(similarity(1.0, far)), f"{far:.4g} m from the display, but the maximum is 20 m")
            for far in (20.1, 1e3)
        ),
        (toml(similarity(-1.0)), "mirrors space"),
        ("", "stack_from_sensor: is missing"),
        ("stack_from_sensor = [[1,", "malformed"),
        *((text, "stack_from_sensor") for text in (toml(np.eye(4)[:3]), "stack_from_sensor = 3")),
        (toml(np.eye(4)[:, :3]), "stack_from_sensor.0"),
        *((toml(np.eye(4)).replace("1.0", one, 1), "stack_from_sensor.0.0") for one in ("nan", "inf", '"1.0"', "true")),
        (toml(np.diag([1.0, 1.0, 1.00077, 1.0])), "to within 0.001, but is off by 0.001"),
        (toml(np.diag([0.0, 0.0, 0.0, 1.0])), "rotation times a single scale"),
        (toml(np.diag([1.0, 1.0, -1.0, 1.0])), "mirrors space"),
        (toml(np.eye(4) + np.eye(4)[[3, 0, 1, 2]] * [0.1, 0, 0, 0]), "rotation times a single scale"),
        (toml(np.eye(4) * 2), "last row"),
        (toml(np.eye(4)) + 'units = "mm"', "units"),
        (toml(np.eye(4)) + "[covariance]\npivot_m = [0, 0, 0]\nmatrix = [[1]]", "covariance.matrix.0"),
        (toml(np.eye(4)) + "[residuals]\nrms_m = -1", "residuals.rms_m"),
        (toml(np.eye(4)) + "condition = inf", "condition"),
    ],
)
def test_a_wrong_file_is_refused_with_its_name_and_the_field(tmp_path: Path, text: str, wanted: str) -> None:
    (tmp_path / "c.toml").write_text(text)
    message = refusal(load_calibration, tmp_path / "c.toml")
    assert wanted in message and str(tmp_path / "c.toml") in message


def test_another_sensor_than_the_calibrated_one_is_warned_of(tmp_path: Path) -> None:
    file = tmp_path / "c.toml"
    file.write_text(toml(np.eye(4)) + 'sensor_serial = "A1"\n')
    calibration = load_calibration(file)
    assert calibration.serial_warning("A1") == "" and "no serial" in calibration.serial_warning("")
    assert "A1" in calibration.serial_warning("B2") and "B2" in calibration.serial_warning("B2")
    assert load_calibration(None).serial_warning("B2") == "", "a calibration of no particular device fits all"


vectors = st.tuples(*[st.floats(-2, 2)] * 3).map(np.array)


@given(vectors, vectors, vectors, st.tuples(*[st.floats(-1, 1)] * 7).map(np.array))
def test_the_jacobian_is_the_derivative_of_the_similarity(
    rotation: NDArray[np.float64], point: NDArray[np.float64], pivot: NDArray[np.float64], direction: np.ndarray
) -> None:
    """A central difference of the real thing, not of its formula."""

    def moved(step: float) -> np.ndarray:
        d = direction * step
        turned = Rotation.from_rotvec(d[:3]).apply(point - pivot)
        return np.exp(d[6]) * turned + pivot + d[3:6]

    slope = (moved(1e-5) - moved(-1e-5)) / 2e-5
    np.testing.assert_allclose(position_jacobian(point, pivot_m=pivot) @ direction, slope, atol=1e-8)


def test_the_error_at_the_eye_grows_with_the_distance_from_the_pairs(tmp_path: Path) -> None:
    file = tmp_path / "c.toml"
    spread = np.diag([1e-3, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3]) ** 2
    file.write_text(toml(np.eye(4)) + f"[covariance]\npivot_m = [0.5, 0, 0]\nmatrix = {spread.tolist()}\n")
    calibration = load_calibration(file)
    near, far = calibration.position_error_m([[0.5, 0.0, 0.0], [1.5, 0.0, 0.0]])
    assert near == pytest.approx(np.sqrt(3) * 1e-3)
    assert far == pytest.approx(np.sqrt(6) * 1e-3), "two axes of rotation and the scale act at a metre's arm"
    assert load_calibration(None).position_error_m([[0.5, 0.0, 0.0]]) is None, "not known is not zero"


@pytest.mark.parametrize(("matrix", "warning"), [
    *((similarity(scale), "far from 1; check that both frames are in metres")
      for scale in (5.1e-4, 7.9e-4, 1.26e-3, 0.79, 1.26, 790.0, 1260.0, 1990.0)),
    *((similarity(scale), "far from 1; one side appears to be in millimetres")
      for scale in (8.1e-4, 1e-3, 1.24e-3, 810.0, 1e3, 1240.0)),
    *((similarity(1.0, away), f"{away} m from the display; check this distance") for away in (5.01, 7.5, 20)),
    *((matrix, "") for matrix in (similarity(0.81), similarity(1.24), similarity(1.0, 5.0))),
    (np.diag([1.0, 1.0, 1.00074, 1.0]), ""),
])  # fmt: skip
def test_a_doubtful_scale_or_distance_is_only_warned_of(tmp_path: Path, matrix: np.ndarray, warning: str) -> None:
    (tmp_path / "c.toml").write_text(toml(matrix))
    told = load_calibration(tmp_path / "c.toml").warnings
    assert len(told) == bool(warning) and all(warning in line for line in told)
