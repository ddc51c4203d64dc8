"""Displayed quality of layers: exactly at the eyes, and beside them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from runtime.optics.malus import intensity_from_phase
from runtime.optics.quality import Quality, psnr_db, quality
from runtime.optics.retina import Mask, sample_bilinear, seen_by
from runtime.optics.rpu import panel_from_image
from runtime.optics.stack import PanelStack
from runtime.optics.views import image_from_stack
from runtime.records import F32, U8
from runtime.report.pairs import OffView, StillPair

OFF_STEP = 3  # beside the eyes, every third ray of every third row is enough for a mean squared error


@dataclass(frozen=True, slots=True)
class Seen:
    """What a pair's eyes see of some layers, in numbers."""

    quality: Quality
    off_db: dict[str, float]  # "2mm": mean over eyes and directions; empty where the pair has no such views


def as_intensity(image: U8) -> F32:
    return image[..., :3].astype(np.float32) / np.float32(255)


def judged(pair: StillPair, layers: U8) -> Seen:
    """Displayed quality at the eyes (design 5.5), and beside them."""
    retinas = [seen_by(eye, layers, pair.stack, fov_deg=pair.fov_deg, **_size(pair)) for eye in pair.eyes_m]
    wanted = [as_intensity(image) for image in pair.images]
    exact = quality([r.image for r in retinas], wanted, [r.mask for r in retinas])
    return Seen(exact, off_eye_db(pair.off, layers, pair.stack, fov_deg=pair.fov_deg))


def off_eye_db(views: Iterable[OffView], layers: U8, stack: PanelStack, *, fov_deg: float) -> dict[str, float]:
    """Mean PSNR of the views at each distance from the eyes."""
    found: dict[str, list[float]] = {}
    for view in views:
        value = single_psnr_db(view.eye_m, layers, stack, wanted=view.image, fov_deg=fov_deg, step=OFF_STEP)
        found.setdefault(f"{view.mm:g}mm", []).append(value)
    return {name: float(np.mean(values)) for name, values in found.items()}


def single_psnr_db(
    eye_m: ArrayLike, layers: U8, stack: PanelStack, *, wanted: U8, fov_deg: float, step: int = 1
) -> float:
    """Displayed PSNR of one eye over every `step`-th ray of every `step`-th row. NaN where no ray counts."""
    image, mask = seen_rays(
        eye_m, layers, stack, width_px=wanted.shape[1], height_px=wanted.shape[0], fov_deg=fov_deg, step=step
    )
    difference = image[mask] - as_intensity(wanted[::step, ::step])[mask]
    return psnr_db(float(np.square(difference, dtype=np.float64).mean())) if difference.size else float("nan")


def seen_rays(
    eye_m: ArrayLike, layers: U8, stack: PanelStack, *, width_px: int, height_px: int, fov_deg: float, step: int
) -> tuple[F32, Mask]:
    """`seen_by` for some of an image's rays: every `step`-th column and row, from the first."""
    u, v = np.arange(0, width_px, step) + 0.5, (np.arange(0, height_px, step) + 0.5)[:, None]
    projection = image_from_stack(eye_m, width_px=width_px, height_px=height_px, fov_deg=fov_deg)
    # A ray's direction is the inverse of the projection's left part times (u, v, 1); it must go towards the panels.
    toward = np.linalg.inv(projection[:, :3])[0]
    mask: Mask = toward[0] * u + toward[1] * v + toward[2] < 0
    total = np.zeros((*mask.shape, 3), np.float32)
    for index in range(stack.count):
        h = panel_from_image(projection, stack.panel(index))
        with np.errstate(divide="ignore", invalid="ignore"):
            weight = h[2, 0] * u + h[2, 1] * v + h[2, 2]
            x, y = (((row[0] * u + row[1] * v + row[2]) / weight).astype(np.float32) for row in h[:2])
        total += sample_bilinear(layers[index][..., :3], u=x, v=y)
        mask &= (x > 0.5) & (x < stack.width_px - 0.5) & (y > 0.5) & (y < stack.height_px - 0.5)
    return intensity_from_phase(total * np.float32(1 / 255)), mask


def _size(pair: StillPair) -> dict[str, int]:
    return {"width_px": pair.images[0].shape[1], "height_px": pair.images[0].shape[0]}
