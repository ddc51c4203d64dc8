"""Tests values of pictures between their pixels."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.optics.sampling import bilinear, nearest


@given(st.integers(1, 5), st.integers(1, 5), st.floats(-2, 7), st.floats(-2, 7), st.booleans())
def test_a_bilinear_value_is_the_mean_of_four_pixels_by_distance(
    height: int, width: int, x: float, y: float, codes: bool
) -> None:
    picture = np.random.default_rng(1).integers(0, 256, (height, width, 3)).astype(np.uint8 if codes else np.float32)
    found = bilinear(picture, np.array([[x]]), np.array([[y]]))[0, 0]
    column, row = min(max(x - 0.5, 0), width - 1), min(max(y - 0.5, 0), height - 1)
    total = np.zeros(3)
    for v in range(height):
        for u in range(width):
            total += max(0.0, 1 - abs(column - u)) * max(0.0, 1 - abs(row - v)) * picture[v, u]
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, total, atol=1e-3)


def test_the_nearest_pixel_is_the_one_that_the_position_is_in() -> None:
    picture = np.arange(12, dtype=np.float32).reshape(3, 4)
    x, y = np.array([[-1.0, 0.0, 0.99, 1.0, 3.5, 9.0]]), np.array([[0.5], [1.0], [2.99]])
    assert nearest(picture, x, y).tolist() == [[0, 0, 0, 1, 3, 3], [4, 4, 4, 5, 7, 7], [8, 8, 8, 9, 11, 11]]


def test_columns_and_rows_are_broadcast() -> None:
    picture = np.random.default_rng(1).random((5, 6), np.float32)
    x, y = np.linspace(0, 6, 9)[None], np.linspace(0, 5, 7)[:, None]
    assert np.array_equal(bilinear(picture, x, y), bilinear(picture, *np.broadcast_arrays(x, y)))


@pytest.mark.parametrize("nowhere", [np.full((1, 1), np.nan, np.float32), np.full((1, 1), np.nan)])
def test_a_position_that_is_not_a_number_counts_as_0(nowhere: np.ndarray) -> None:
    picture = np.array([[3.0, 4.0]], np.float32)
    assert bilinear(picture, nowhere, nowhere) == nearest(picture, nowhere, nowhere) == 3.0
