"""Tests that each monitor pixel shows the right layer pixel for any mounting."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.panels.geometry import layer_from_screen, panel_from_screen, permutes_pixels

SIZES = st.tuples(st.integers(16, 4096), st.integers(16, 4096))
MOUNTED = st.sampled_from([0, 90, 180, 270])
MIRRORED = st.sampled_from(["none", "horizontal", "vertical"])


def apply(matrix: Any, x: Any, y: Any) -> Any:
    u, v, w = matrix @ np.array([x, y, 1.0])
    return u / w, v / w


@given(size=SIZES, rotation_deg=MOUNTED, mirror=MIRRORED)
def test_without_registration_pixels_are_only_permuted(size: Any, rotation_deg: Any, mirror: Any) -> None:
    width, height = size
    matrix = panel_from_screen(screen_width_px=width, screen_height_px=height, rotation_deg=rotation_deg, mirror=mirror)
    assert permutes_pixels(matrix)
    corners = {apply(matrix, x, y) for x in (0, width) for y in (0, height)}
    columns, rows = (height, width) if rotation_deg in (90, 270) else (width, height)
    assert corners == {(x, y) for x in (0, columns) for y in (0, rows)}


@given(size=SIZES, rotation_deg=MOUNTED, mirror=MIRRORED, dx=st.floats(-20, 20), tilt=st.floats(-1e-5, 1e-5))
def test_an_ideal_pixel_is_drawn_where_registration_found_it(
    size: Any, rotation_deg: Any, mirror: Any, dx: Any, tilt: Any
) -> None:
    width, height = size
    homography = np.array([[1.01, 0.002, dx], [-0.003, 0.99, 2.0], [tilt, 0.0, 1.0]])
    common = {"screen_width_px": width, "screen_height_px": height, "rotation_deg": rotation_deg, "mirror": mirror}
    columns, rows = (height, width) if rotation_deg in (90, 270) else (width, height)
    layer = layer_from_screen(**common, layer_width_px=columns, layer_height_px=rows, homography=homography)
    ideal = (0.3 * columns, 0.7 * rows)
    true = apply(homography, *ideal)
    screen = apply(np.linalg.inv(panel_from_screen(**common)), *true)
    assert apply(layer, *screen) == pytest.approx(ideal, abs=1e-6 * max(size))


def test_layers_of_half_the_resolution_fill_the_panel() -> None:
    matrix = layer_from_screen(
        screen_width_px=1920, screen_height_px=1080, layer_width_px=960, layer_height_px=540,
        rotation_deg=0, mirror="none", homography=np.eye(3),
    )  # fmt: skip
    assert apply(matrix, 1920, 1080) == pytest.approx((960, 540))
    assert not permutes_pixels(matrix)


def test_a_shift_by_a_whole_pixel_is_a_permutation_by_half_not() -> None:
    assert not permutes_pixels(np.array([[1, 0, 0.5], [0, 1, 0], [0, 0, 1.0]]))
    assert permutes_pixels(np.array([[1, 0, 1.0], [0, 1, 0], [0, 0, 1.0]]))


def test_a_singular_homography_is_refused() -> None:
    with pytest.raises(ValueError, match="invertible"):
        layer_from_screen(
            screen_width_px=16, screen_height_px=16, layer_width_px=16, layer_height_px=16,
            rotation_deg=0, mirror="none", homography=((1, 0, 0), (2, 0, 0), (0, 0, 1)),
        )  # fmt: skip


@pytest.mark.parametrize("place", [(2, 0), (2, 1)])
def test_a_perspective_registration_is_no_permutation_however_weak(place: tuple[int, int]) -> None:
    matrix = np.eye(3)
    matrix[place] = 1e-12
    assert not permutes_pixels(matrix)
