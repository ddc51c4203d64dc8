"""Pictures on the retina of an eye that focuses, and their error."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.optics.focus import FocusCamera, points_of_pupils, retina_db
from runtime.optics.pupil import PUPIL_MM
from runtime.optics.retina import pupil_points
from runtime.optics.stack import PanelStack
from runtime.optics.views import image_from_stack, stack_from_eye
from runtime.records import F64

CAMERA, PUPIL_M = FocusCamera(72, 30, 18.0), PUPIL_MM / 1e3
EYES = np.array([[0.4, -0.0315, 0.0], [0.4, 0.0315, 0.0]])
EYE = EYES[1]


def pixel(matrix: np.ndarray, point: np.ndarray) -> np.ndarray:
    weighted = matrix @ [*point, 1.0]
    return weighted[:2] / weighted[2]


@given(st.floats(0.2, 2.0), st.floats(-0.05, 0.05), st.floats(-0.05, 0.05), st.integers(0, 18))
def test_all_points_of_the_pupil_see_a_focused_point_alike(focus_m: float, right: float, up: float, index: int) -> None:
    pose = stack_from_eye(EYE)
    point = EYE - focus_m * pose[:3, 2] + right * pose[:3, 0] + up * pose[:3, 1]
    beside = CAMERA.projection(EYE, pupil_points(PUPIL_M)[index], focus_m=focus_m)
    middle = CAMERA.projection(EYE, np.zeros(2), focus_m=focus_m)
    np.testing.assert_allclose(pixel(beside, point), pixel(middle, point), atol=1e-8)


def test_the_middle_of_the_pupil_is_the_pinhole_eye() -> None:
    plain = image_from_stack(EYE, width_px=CAMERA.width_px, height_px=CAMERA.height_px, fov_deg=CAMERA.fov_deg)
    np.testing.assert_allclose(CAMERA.projection(EYE, np.zeros(2), focus_m=0.3), plain, atol=1e-9)


def test_out_of_focus_the_pupil_sees_a_disc_of_the_optical_size() -> None:
    """Blur = aperture·|1/f - 1/z|·focal length, from similar triangles."""
    pose = stack_from_eye(EYE)
    point = EYE - 0.5 * pose[:3, 2]
    edge = np.array([PUPIL_M / 2, 0.0])
    spread = pixel(CAMERA.projection(EYE, edge, focus_m=0.4), point) - pixel(
        CAMERA.projection(EYE, -edge, focus_m=0.4), point
    )
    focal_px = CAMERA.projection(EYE, np.zeros(2), focus_m=0.4)[:, :3] @ pose[:3, 0]
    expected = PUPIL_M * (1 / 0.4 - 1 / 0.5) * focal_px[0]
    np.testing.assert_allclose(spread, [expected, 0.0], atol=1e-9)


@pytest.mark.parametrize(("errors", "expected_db"), [((0.1,), 20.0), ((0.1, 0.0), 23.0103), ((0.2, 0.1, 0.1), 16.9897)])
def test_the_error_is_one_mean_over_all_pictures(errors: tuple[float, ...], expected_db: float) -> None:
    true = np.full((4, 6, 3), 0.5, np.float32)
    assert retina_db([(true + np.float32(error), true) for error in errors]) == pytest.approx(expected_db, abs=1e-3)


def test_without_pictures_there_is_no_error() -> None:
    with pytest.raises(ValueError, match="at least one"):
        retina_db([])


def test_an_edge_is_sharp_in_focus_and_blurred_elsewhere() -> None:
    """A black and white edge at x = 0, drawn for each point of the pupil, spreads over the disc's width."""
    wide = FocusCamera(1440, 4, 18.0)

    def edge(matrix: F64) -> np.ndarray:
        at = matrix @ [0.0, 0.0, 0.0, 1.0]
        columns = np.arange(wide.width_px) + 0.5
        return (
            np.repeat(np.clip(columns - at[0] / at[2] + 0.5, 0, 1)[None, :, None], 4, 0).repeat(3, 2).astype(np.float32)
        )

    eye = np.array([0.4, 0.0, 0.0])
    sharp, blurred = (wide.focused(eye, edge, plane_m=plane_m)[0, :, 0] for plane_m in (0.0, 0.05))
    focal_px = 720 / np.tan(np.radians(9.0))
    disc_px = PUPIL_M * (1 / 0.35 - 1 / 0.4) * focal_px
    grey = [int(((row > 0.01) & (row < 0.99)).sum()) for row in (sharp, blurred)]
    assert grey[0] <= 2 and 0.6 * disc_px < grey[1] <= disc_px + 2


def test_layers_that_are_even_are_seen_even_at_any_distance() -> None:
    stack = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 96, 54)
    layers = np.full((3, 54, 96, 3), 85, np.uint8)
    seen = CAMERA.focused(EYE, lambda matrix: CAMERA.through(matrix, layers, stack), plane_m=0.05)
    np.testing.assert_allclose(seen, 1.0, atol=1e-5)


def test_the_points_of_pupils_are_listed_point_by_point() -> None:
    points = points_of_pupils(EYES).reshape(-1, 2, 3)
    np.testing.assert_allclose(points[0], EYES, atol=1e-12)
    np.testing.assert_allclose(points.mean(axis=0), EYES, atol=1e-12)
    assert (np.linalg.norm(points - EYES, axis=2) < PUPIL_M / 2).all()
