"""Fast resampling against exact bilinear samples."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from runtime.model.resample import WORST_PHASE, buffer, resample
from tests.model.scenes import sampled

HEIGHT, WIDTH = 96, 128


def smooth(seed: int) -> np.ndarray:
    """A picture of low frequencies, so that a shift by part of a pixel has a known effect."""
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH]
    phase = np.random.default_rng(seed).uniform(0, 6.28, (2, 3))
    waves = np.sin(u[..., None] / 7 + phase[0]) + np.sin(v[..., None] / 9 + phase[1])
    return np.rint(1000 * waves).astype(np.int16)


@settings(max_examples=60)
@given(
    scale=st.floats(0.5, 2.0),
    shift_u=st.floats(-60, 60),
    shift_v=st.floats(-60, 60),
    shear=st.sampled_from([0.0, 0.0, 0.03, -0.2]),
    seed=st.integers(0, 5),
)
def test_samples_are_where_the_matrix_says(
    scale: float, shift_u: float, shift_v: float, shear: float, seed: int
) -> None:
    image = smooth(seed)
    matrix = np.array([[scale, 0.0, shift_u], [shear, scale, shift_v], [0.0, 0.0, 1.0]])
    out = buffer(HEIGHT, WIDTH)
    result = resample(image, image_from_result=matrix, out=out)
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    su, sv = scale * u + shift_u, shear * u + scale * v + shift_v
    exact = sampled(image.astype(np.float32), su, sv)
    inside = (su > 1) & (su < WIDTH - 1) & (sv > 1) & (sv < HEIGHT - 1)
    # The steepest slope of the picture is 1000/7 + 1000/9 a pixel.
    tolerance = (WORST_PHASE + 1 / 32) * 254 * 1.5 + 2
    assert np.abs(result - exact)[inside].max(initial=0.0) <= tolerance


@pytest.mark.parametrize("scale", [20.0, 400.0])
def test_an_image_that_shrinks_to_a_few_pixels_or_less_is_sampled_all_the_same(scale: float) -> None:
    image = smooth(1)
    matrix = np.array([[scale, 0.0, 3.0], [0.0, scale, 3.0], [0.0, 0.0, 1.0]])
    result = resample(image, image_from_result=matrix, out=buffer(HEIGHT, WIDTH))
    if scale < 100:
        exact = sampled(image.astype(np.float32), np.array([[13.0]]), np.array([[13.0]]))
        assert np.abs(result[0, 0] - exact[0, 0]).max() <= 12


def test_beside_the_image_stands_the_given_value() -> None:
    out = buffer(HEIGHT, WIDTH)
    matrix = np.array([[1.0, 0.0, -40.0], [0.0, 1.0, -30.0], [0.0, 0.0, 1.0]])
    result = resample(smooth(0), image_from_result=matrix, out=out, outside=77)
    assert (result[:30] == 77).all()
    assert (result[:, :40] == 77).all()
    assert (result[30:, 40:] == smooth(0)[: HEIGHT - 30, : WIDTH - 40]).all()
