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
    sizes = {"screen_width_px": 1920, "screen_height_px": 1080, "layer_width_px": 960, "layer_height_px": 540}
    matrix = layer_from_screen(**sizes, rotation_deg=0, mirror="none", homography=np.eye(3))
    assert apply(matrix, 1920, 1080) == pytest.approx((960, 540))
    assert not permutes_pixels(matrix)


@pytest.mark.parametrize(
    ("entries", "permutes"),
    [
        ({(0, 2): 1.0}, True),
        ({(0, 2): -1e-12, (1, 2): 1e-12}, True),  # as rounding leaves them
        *(({(row, 2): shift}, False) for row in (0, 1) for shift in (0.5, 1.5, 1.5e-9, -1.5e-9)),
        *(({(0, 0): scale, (1, 1): 1.0}, False) for scale in (0.5, 2.0, 0.0)),
        *(({place: 1.5e-12}, False) for place in ((0, 1), (1, 0))),
        *(({(2, column): weak}, False) for column in (0, 1) for weak in (1e-12, 1e-15)),
        ({(2, 2): 0.0}, False),
    ],
)
def test_only_turns_and_shifts_by_whole_pixels_are_permutations(entries: Any, permutes: bool) -> None:
    matrix = np.eye(3)
    for place, value in entries.items():
        matrix[place] = value
    assert permutes_pixels(matrix) == permutes


@pytest.mark.parametrize(
    "homography", [((1, 0, 0), (2, 0, 0), (0, 0, 1)), np.diag([1, np.nan, 1]), np.diag([1, 1, 9e-13])]
)
def test_a_singular_homography_is_refused(homography: Any) -> None:
    common = {"screen_width_px": 16, "screen_height_px": 16, "layer_width_px": 16, "layer_height_px": 16}
    with pytest.raises(ValueError, match="invertible"):
        layer_from_screen(**common, rotation_deg=0, mirror="none", homography=homography)
    layer_from_screen(**common, rotation_deg=0, mirror="none", homography=np.diag([1, 1, 1e-12]))
