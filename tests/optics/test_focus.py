"""Pictures on the retina of an eye that focuses, and their error."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.optics.focus import RetinaPixels, points_of_pupils, retina_db
from runtime.optics.pupil import PUPIL_MM
from runtime.optics.retina import Retina
from runtime.optics.stack import PanelStack
from runtime.optics.views import raster_from_stack
from runtime.records import F64

STACK, PUPIL_M = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 192, 108), PUPIL_MM / 1e3
PIXELS = RetinaPixels(STACK.panel(1))
EYES = np.array([[0.4, -0.0315, 0.0], [0.4, 0.0315, 0.0]])
EYE = EYES[1]


def pixel(matrix: np.ndarray, point: np.ndarray) -> np.ndarray:
    weighted = matrix @ [*point, 1.0]
    return weighted[:2] / weighted[2]


@given(st.floats(-0.3, 0.2), st.floats(-0.05, 0.05), st.floats(-0.05, 0.05))
def test_all_points_of_the_pupil_see_a_focused_point_alike(plane_m: float, y: float, z: float) -> None:
    seen = [pixel(matrix, np.array([plane_m, y, z])) for _, matrix in PIXELS.projections(EYE, plane_m=plane_m)]
    np.testing.assert_allclose(seen, [seen[0]] * 19, atol=1e-8)


@given(st.floats(-0.3, 0.2), st.floats(-0.05, 0.05), st.floats(-0.05, 0.05))
def test_the_middle_of_the_pupil_is_the_pinhole_eye(plane_m: float, y: float, z: float) -> None:
    point, matrix = PIXELS.projections(EYE, plane_m=plane_m)[0]
    plain = raster_from_stack(EYE, PIXELS.raster)
    assert np.array_equal(point, EYE)
    np.testing.assert_allclose(pixel(matrix, np.array([0.03, y, z])), pixel(plain, np.array([0.03, y, z])), atol=1e-8)


def test_out_of_focus_the_pupil_sees_a_disc_of_the_optical_size() -> None:
    """In the plane in focus, a point's blur is the pupil times (z - f)/z, from similar triangles."""
    eye = np.array([0.4, 0.0, 0.0])
    matrices = [matrix for _, matrix in PIXELS.projections(eye, plane_m=0.0)]
    places = np.array([pixel(matrix, np.array([-0.1, 0.0, 0.0])) for matrix in matrices])
    across_m = np.ptp(places[:, 0]) * PIXELS.raster.pitch_u_m
    outermost = 2 / 2.5  # the outer ring of points is inside the pupil's edge
    assert across_m == pytest.approx(outermost * PUPIL_M * 0.1 / 0.5, rel=1e-6)


@pytest.mark.parametrize(("errors", "expected_db"), [((0.1,), 20.0), ((0.1, 0.0), 23.0103), ((0.2, 0.1, 0.1), 16.9897)])
def test_the_error_is_one_mean_over_all_counted_pixels(errors: tuple[float, ...], expected_db: float) -> None:
    true = np.full((4, 6, 3), 0.5, np.float32)
    mask = np.ones((4, 6), bool)
    mask[0] = False
    seen = [Retina(np.where(mask[..., None], true + np.float32(error), 9), mask) for error in errors]
    assert retina_db([(retina, true) for retina in seen]) == pytest.approx(expected_db, abs=1e-3)


def test_without_pictures_there_is_no_error() -> None:
    assert np.isnan(retina_db([]))


def test_an_edge_is_sharp_in_focus_and_blurred_elsewhere() -> None:
    """A black and white edge at x = 0, drawn for each point of the pupil, spreads over the disc's width."""
    wide = RetinaPixels(PanelStack(0.12, 0.0004, (0.0,), 1440, 4).panel(0))

    def edge(point: F64, matrix: F64) -> np.ndarray:
        columns = np.arange(1440) + 0.5
        row = np.clip(columns - pixel(matrix, np.zeros(3))[0] + 0.5, 0, 1)
        return np.tile(row[None, :, None], (4, 1, 3)).astype(np.float32)

    eye = np.array([0.4, 0.0, 0.0])
    sharp, blurred = (wide.true(edge, eye, plane_m=plane_m)[0, :, 0] for plane_m in (0.0, 0.05))
    disc_px = PUPIL_M * 0.05 / 0.35 / wide.raster.pitch_u_m
    grey = [int(((row > 0.01) & (row < 0.99)).sum()) for row in (sharp, blurred)]
    assert grey[0] <= 2 and 0.6 * disc_px < grey[1] <= disc_px + 2


def test_layers_that_are_even_are_seen_even_at_any_distance() -> None:
    seen = PIXELS.seen(np.full((3, 108, 192, 3), 85, np.uint8), STACK, EYE, plane_m=0.05)
    np.testing.assert_allclose(seen.image, 1.0, atol=1e-5)
    assert seen.mask[:, 96].any() and not seen.mask[:, 0].any()  # beside the panels in front, nothing is seen


def test_the_points_of_pupils_are_listed_point_by_point() -> None:
    points = points_of_pupils(EYES).reshape(-1, 2, 3)
    np.testing.assert_allclose(points[0], EYES, atol=1e-12)
    np.testing.assert_allclose(points.mean(axis=0), EYES, atol=1e-12)
    assert (np.linalg.norm(points - EYES, axis=2) < PUPIL_M / 2).all()
