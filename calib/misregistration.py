"""What a misaligned stack does to the picture: layers seen through panels that are not where they should be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import ArrayLike

from calib.registration import through
from runtime.optics.malus import intensity_from_phase
from runtime.optics.quality import Quality, quality
from runtime.optics.retina import Retina, panel_positions, ray_mask, sample_bilinear
from runtime.optics.stack import PanelStack
from runtime.records import F32, F64, U8


def seen_through(
    eye_m: ArrayLike,
    layers: U8 | F32,
    stack: PanelStack,
    true_from_ideal: Sequence[F64],
    *,
    fov_deg: float,
    width_px: int,
    height_px: int,
) -> Retina:
    """What an eye sees where panel n's pixels lie displaced by a homography (3, 3): `optics.retina.seen_by` of it.

    Tilts are told by the homographies of this eye, not by the stack.
    """
    stack = replace(stack, tilt=None)
    total = np.zeros((height_px, width_px, 3), np.float32)
    mask = ray_mask(eye_m, stack, width_px=width_px, height_px=height_px, fov_deg=fov_deg)
    for index, matrix in enumerate(true_from_ideal):
        u, v = panel_positions(eye_m, stack, index=index, width_px=width_px, height_px=height_px, fov_deg=fov_deg)
        if not np.array_equal(matrix, np.eye(3)):
            places = through(matrix, np.column_stack([u.ravel(), v.ravel()]).astype(np.float64))
            u, v = (places[:, axis].reshape(u.shape).astype(np.float32) for axis in (0, 1))
        total += sample_bilinear(layers[index][..., :3], u=u, v=v)
        mask &= (u > 0.5) & (u < stack.width_px - 0.5) & (v > 0.5) & (v < stack.height_px - 0.5)
    if layers.dtype == np.uint8:
        total *= np.float32(1 / 255)
    return Retina(intensity_from_phase(total), mask)


def corrected(layers: U8, true_from_ideal: Sequence[F64]) -> U8:
    """The layers as the presentation shader shows them on registered panels: bicubic, black beyond the edges."""
    half = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])
    whole = np.linalg.inv(half)
    height, width = layers.shape[1:3]
    shown = [
        layer
        if np.array_equal(matrix, np.eye(3))
        else cv2.warpPerspective(layer, whole @ matrix @ half, (width, height), flags=cv2.INTER_CUBIC)
        for layer, matrix in zip(layers, true_from_ideal, strict=True)
    ]
    return np.ascontiguousarray(np.stack(shown))


def displayed_quality(
    layers: U8,
    wanted: Sequence[U8],
    eyes_m: F64,
    stack: PanelStack,
    true_from_ideal: Sequence[F64],
    *,
    fov_deg: float,
) -> Quality:
    """Quality of both eyes' pictures (docs/contracts.md) on a stack with such panels; `wanted`: two (h, w, 3 or 4)."""
    height, width = wanted[0].shape[:2]
    seen = [
        seen_through(eye, layers, stack, true_from_ideal, fov_deg=fov_deg, width_px=width, height_px=height)
        for eye in eyes_m
    ]
    targets = [picture[..., :3].astype(np.float32) / np.float32(255) for picture in wanted]
    return quality([r.image for r in seen], targets, [r.mask for r in seen])


def shifted(stack: PanelStack, *, index: int, shift_px: Sequence[float]) -> list[F64]:
    """Homographies of a stack in which one panel is displaced by (u, v) pixels and the others are right."""
    matrices = [np.eye(3) for _ in range(stack.count)]
    matrices[index][:2, 2] = shift_px
    return matrices
