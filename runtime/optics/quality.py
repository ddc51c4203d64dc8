"""Displayed quality (design 5.5): PSNR and SSIM of what an eye sees after clipping and 8 bits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from runtime.optics.retina import Mask
from runtime.records import F32


@dataclass(frozen=True, slots=True)
class Quality:
    """One number each for all eyes together, and each eye's own."""

    psnr_db: float  # of one mean squared error over all counted pixels, channels and eyes
    ssim: float  # mean over eyes
    eye_psnr_db: tuple[float, ...]


def psnr_db(mean_squared_error: float) -> float:
    """Peak signal to noise ratio for intensities in [0, 1]; 120 dB at most."""
    return float(-10 * np.log10(max(mean_squared_error, 1e-12)))


def ssim(a: F32, b: F32, mask: Mask) -> float:
    """Mean structural similarity over a mask: 11x11 Gaussian window of sigma 1.5 (Wang et al. 2004)."""
    import cv2

    def blur(x: F32) -> F32:
        return np.asarray(cv2.GaussianBlur(x, (11, 11), 1.5), dtype=np.float32)

    c1, c2 = np.float32(0.01**2), np.float32(0.03**2)
    mean_a, mean_b = blur(a), blur(b)
    var_a, var_b = blur(a * a) - mean_a**2, blur(b * b) - mean_b**2
    covariance = blur(a * b) - mean_a * mean_b
    value = (2 * mean_a * mean_b + c1) * (2 * covariance + c2) / ((mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2))
    return float(value[mask].mean())


def quality(seen: Sequence[F32], wanted: Sequence[F32], masks: Sequence[Mask]) -> Quality:
    """Pooled displayed quality over eyes. Raises ValueError where no ray crosses every panel."""
    errors, weights, per_eye, similarities = 0.0, 0, [], []
    for image, target, mask in zip(seen, wanted, masks, strict=True):
        squared = (image[mask].astype(np.float64) - target[mask]) ** 2
        if squared.size == 0:
            raise ValueError("no ray of this eye crosses every panel")
        errors, weights = errors + float(squared.sum()), weights + squared.size
        per_eye.append(psnr_db(float(squared.mean())))
        similarities.append(ssim(image, target, mask))
    return Quality(psnr_db(errors / weights), float(np.mean(similarities)), tuple(per_eye))
