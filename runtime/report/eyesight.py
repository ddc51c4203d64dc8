"""Displayed quality of layers: exactly at the eyes, and away from them."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from runtime.evaluation.displayed import Picture, displayed, expected_db
from runtime.optics.carried import intensities
from runtime.optics.quality import Quality, psnr_db
from runtime.optics.retina import Mask, seen_by
from runtime.optics.stack import PanelStack
from runtime.records import F32, U8
from runtime.report.pairs import OffView, StillPair

SIGMAS_MM = (1.0, 2.0)  # a pupil alone, a pupil and a good tracker
ENOUGH_RAYS = 200_000  # of an eye, for an expected error
OFF_STEP = 3  # away from the eyes, every third ray of every third row is enough for a mean squared error


@dataclass(frozen=True, slots=True)
class Seen:
    """What a pair's eyes see of some layers, in numbers."""

    quality: Quality  # exactly at the eyes
    expected_db: dict[str, float]  # "1": of eyes that are 1 mm unsure; without those that would see nothing
    off_db: dict[str, float]  # "2mm": mean over eyes and directions; empty where the pair has no such views


def as_intensity(image: Picture) -> F32:
    """(h, w, 3) intensities in [0, 1] of a picture of 8 or 16 bits, or of one that is intensities already."""
    return intensities(image)


def judged(pair: StillPair, layers: U8) -> Seen:
    """Displayed quality: exact at the eyes, expected (docs/contracts.md, Error), and at places away from them."""
    eye_views = displayed(layers, pair.wanted, pair.stack, eyes_m=pair.eyes_m, fov_deg=pair.fov_deg)
    expected = expected_db(
        eye_views,
        layers,
        pair.stack,
        eyes_m=pair.eyes_m,
        fov_deg=pair.fov_deg,
        sigmas_mm=SIGMAS_MM,
        step=_enough(pair.images[0]),
    )
    known = {sigma: value for sigma, value in expected.items() if value is not None}
    return Seen(eye_views.quality, known, off_eye_db(pair.off, layers, pair.stack, fov_deg=pair.fov_deg))


def _enough(picture: Picture) -> int:
    """Of every so-manieth ray a mean squared error is known to some hundredths of a decibel."""
    return max(1, math.isqrt(picture.shape[0] * picture.shape[1] // ENOUGH_RAYS))


def off_eye_db(views: Iterable[OffView], layers: U8, stack: PanelStack, *, fov_deg: float) -> dict[str, float]:
    """Mean PSNR of the views at each distance from the eyes."""
    found: dict[str, list[float]] = {}
    for view in views:
        value = single_psnr_db(view.eye_m, layers, stack, wanted=view.image, fov_deg=fov_deg, step=OFF_STEP)
        found.setdefault(f"{view.mm:g}mm", []).append(value)
    return {name: float(np.mean(values)) for name, values in found.items()}


def single_psnr_db(
    eye_m: ArrayLike, layers: U8, stack: PanelStack, *, wanted: Picture, fov_deg: float, step: int = 1
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
    """(h, w, C) and (h, w): `seen_by` for some of an image's rays: every `step`-th column and row, from the first."""
    retina = seen_by(eye_m, layers, stack, width_px=width_px, height_px=height_px, fov_deg=fov_deg, step=step)
    return retina.image, retina.mask
