"""Displayed quality (docs/contracts.md): PSNR and SSIM of images seen through the layers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from runtime.optics.retina import Mask, strips
from runtime.records import F32

HALF_WINDOW = 5  # pixels on each side of the central pixel in the SSIM window


@dataclass(frozen=True, slots=True)
class Quality:
    """PSNR and SSIM over the eyes' images, and the PSNR of each eye's image."""

    psnr_db: float  # computed from the mean squared error over all counted pixels, channels and eyes
    ssim: float  # mean over the eyes; NaN if not computed
    eye_psnr_db: tuple[float, ...]


def psnr_db(mean_squared_error: float) -> float:
    """Return the peak signal-to-noise ratio in dB, at most 120 dB, for intensities in [0, 1]."""
    return float(-10 * np.log10(max(mean_squared_error, 1e-12)))


def ssim(a: F32, b: F32, mask: Mask) -> float:
    """Return the mean SSIM over a mask (Wang et al. 2004; 11x11 Gaussian window of sigma 1.5 pixels)."""

    def blur(x: F32) -> F32:
        return np.asarray(cv2.GaussianBlur(x, (11, 11), 1.5), dtype=np.float32)[inside]

    c1, c2 = np.float32(0.01**2), np.float32(0.03**2)
    total, counted = 0.0, 0
    for rows in strips(len(mask)):
        if not mask[rows].any():
            continue
        # Add half a window at both ends so that every row has a complete window. OpenCV mirrors the image at its
        # border.
        first = max(rows.start - HALF_WINDOW, 0)
        around, inside = slice(first, rows.stop + HALF_WINDOW), slice(rows.start - first, rows.stop - first)
        x, y = a[around], b[around]
        mean_x, mean_y = blur(x), blur(y)
        var_x, var_y = blur(x * x) - mean_x**2, blur(y * y) - mean_y**2
        covariance = blur(x * y) - mean_x * mean_y
        value = (2 * mean_x * mean_y + c1) * (2 * covariance + c2)
        value /= (mean_x**2 + mean_y**2 + c1) * (var_x + var_y + c2)
        part = value[mask[rows]]
        total, counted = total + float(part.sum(dtype=np.float64)), counted + part.size
    return total / counted


def squared_error(image: F32, target: F32, mask: Mask) -> tuple[float, int]:
    """Return the sum of squared differences over the masked pixels, and the number of terms."""
    total, counted = 0.0, 0
    for rows in strips(len(mask)):
        difference = (image[rows] - target[rows])[mask[rows]].astype(np.float64).ravel()
        total, counted = total + float(difference @ difference), counted + difference.size
    return total, counted


def quality(seen: Sequence[F32], targets: Sequence[F32], masks: Sequence[Mask], *, similarity: bool = True) -> Quality:
    """Return the quality of what eyes see; SSIM may be NaN. Raises ValueError if no pixel counts."""
    errors, weights, per_eye, similarities = 0.0, 0, [], []
    for image, target, mask in zip(seen, targets, masks, strict=True):
        squared, counted = squared_error(image, target, mask)
        if counted == 0:
            raise ValueError("no ray from this eye crosses every panel")
        errors, weights = errors + squared, weights + counted
        per_eye.append(psnr_db(squared / counted))
        similarities.append(ssim(image, target, mask) if similarity else np.nan)
    return Quality(psnr_db(errors / weights), float(np.mean(similarities)), tuple(per_eye))
