"""PSNR and SSIM against scikit-image."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from runtime.optics.quality import psnr_db, quality, ssim


def pictures(seed: int, noise: float) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    coarse = rng.random((6, 8, 3))
    wanted = np.kron(coarse, np.ones((8, 8, 1)))
    seen = np.clip(wanted + noise * rng.standard_normal(wanted.shape), 0, 1)
    return seen.astype(np.float32), wanted.astype(np.float32)


def inner(shape: tuple[int, ...]) -> np.ndarray:
    """Away from the border, where the two libraries continue a picture differently."""
    mask = np.zeros(shape[:2], bool)
    mask[6:-6, 6:-6] = True
    return mask


seeds = st.integers(0, 2**31)


@given(seeds, st.floats(1e-3, 0.5))
def test_psnr_is_that_of_scikit_image(seed: int, noise: float) -> None:
    seen, wanted = pictures(seed, noise)
    ours = quality([seen], [wanted], [np.ones(seen.shape[:2], bool)])
    theirs = peak_signal_noise_ratio(wanted.astype(float), seen.astype(float), data_range=1)
    assert ours.psnr_db == pytest.approx(theirs, abs=1e-6)
    assert ours.eye_psnr_db == (ours.psnr_db,)


@given(seeds, st.floats(1e-2, 0.5))
def test_ssim_is_that_of_scikit_image(seed: int, noise: float) -> None:
    seen, wanted = pictures(seed, noise)
    _, full = structural_similarity(
        seen.astype(float),
        wanted.astype(float),
        data_range=1,
        channel_axis=2,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
    )
    mask = inner(seen.shape)
    assert ssim(seen, wanted, mask) == pytest.approx(full[mask].mean(), abs=2e-4)


@given(seeds, seeds)
def test_two_eyes_are_pooled_by_their_squared_errors(first: int, second: int) -> None:
    left, right = pictures(first, 0.02), pictures(second, 0.2)
    masks = [np.ones(left[0].shape[:2], bool), inner(right[0].shape)]
    pooled = quality([left[0], right[0]], [left[1], right[1]], masks)
    squares = np.concatenate([((s - w)[m].astype(float) ** 2).ravel() for (s, w), m in zip((left, right), masks)])
    assert pooled.psnr_db == pytest.approx(-10 * np.log10(squares.mean()), abs=1e-5)
    assert min(pooled.eye_psnr_db) <= pooled.psnr_db <= max(pooled.eye_psnr_db)


def test_equal_pictures_are_perfect_and_not_infinite() -> None:
    _, wanted = pictures(1, 0.0)
    perfect = quality([wanted], [wanted], [np.ones(wanted.shape[:2], bool)])
    assert perfect.psnr_db == psnr_db(0.0) == 120.0
    assert perfect.ssim == pytest.approx(1.0, abs=1e-6)


def test_an_eye_without_a_counted_ray_is_refused() -> None:
    seen, wanted = pictures(1, 0.1)
    with pytest.raises(ValueError, match="no ray"):
        quality([seen], [wanted], [np.zeros(seen.shape[:2], bool)])
