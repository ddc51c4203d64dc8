"""Measure the displayed quality of layers against target pictures (docs/contracts.md, Error)."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import cv2
import numpy as np

from runtime.browser.still import viewer_html
from runtime.optics.carried import expected_errors, intensities, standard_error_db
from runtime.optics.light import Sampling
from runtime.optics.quality import Quality, psnr_db, quality
from runtime.optics.retina import Retina, as_codes, seen_by
from runtime.optics.stack import PanelStack
from runtime.records import F32, U8, Eyes
from runtime.support.artifacts import write_png
from runtime.support.threads import parallel_map

Picture = U8 | F32  # (h, w, 3), code values or intensities in [0, 1]
P = TypeVar("P", bound=Picture)
SIGMAS_MM = (0.0, 1.0, 2.0)  # tracking errors: none, a good tracker's, and twice a good tracker's


@dataclass(frozen=True, slots=True)
class EyeViews:
    """The images that the eyes see through the layers, with the targets and the measured quality."""

    seen: tuple[Retina, ...]  # the image that each eye sees
    wanted: tuple[Picture, ...]  # the target for each eye
    quality: Quality  # measured exactly at the eyes the layers were solved for or aligned to
    stack: PanelStack
    eyes_m: Eyes  # (V, 3) eye positions, frame `stack`
    fov_deg: float  # horizontal field of view of the images and targets

    def viewer(self, layers: U8, text: Sequence[str], *, relief: F32 | None = None) -> str:
        """Return an HTML viewer page of the first viewer's views, for layers solved for `eyes_m`."""
        shown = [0, min(1, len(self.wanted) - 1)]  # the page shows the first viewer's eyes
        wanted, eyes_m = [as_codes(intensities(self.wanted[n])) for n in shown], np.asarray(self.eyes_m)[shown]
        return viewer_html(layers, wanted, self.stack, eyes_m=eyes_m, fov_deg=self.fov_deg, text=text, relief=relief)

    def write(self, folder: Path) -> None:
        """Write the images and targets to a folder as `seen-left.png`, `wanted-left.png` and so on."""

        def write(side: int) -> None:
            eye = eye_names(len(self.seen))[side]
            write_png(folder / f"seen-{eye}.png", self.seen[side].codes())
            write_png(folder / f"wanted-{eye}.png", as_codes(intensities(self.wanted[side])))

        parallel_map(write, range(len(self.seen)))


def eye_names(count: int) -> tuple[str, ...]:
    """Return the eyes' names: left, right, left-2, right-2 and so on, where 2 is the second viewer."""
    return tuple(("left", "right")[n % 2] + (f"-{n // 2 + 1}" if n > 1 else "") for n in range(count))


def displayed(
    layers: U8, wanted: Sequence[Picture], stack: PanelStack, *, eyes_m: Eyes, fov_deg: float, similarity: bool = True
) -> EyeViews:
    """Compute the images that eyes see through layers, and compare them with targets.

    Targets with the panels' aspect ratio are compared at the panels' resolution. Other targets keep their resolution,
    unless they have more pixels than a panel, in which case they are reduced. Raises ValueError if an eye is behind a
    panel or sees no part of the panels.
    """
    wanted = [on_panels_raster(picture, stack) for picture in wanted]
    seen = tuple(
        seen_by(eye_m, layers, stack, fov_deg=fov_deg, width_px=picture.shape[1], height_px=picture.shape[0])
        for eye_m, picture in zip(eyes_m, wanted, strict=True)
    )
    targets = [intensities(picture) for picture in wanted]
    measured = quality([r.image for r in seen], targets, [r.mask for r in seen], similarity=similarity)
    return EyeViews(seen, tuple(wanted), measured, stack, eyes_m, fov_deg)


class Expected(NamedTuple):
    """Expected PSNR (docs/contracts.md, Error), keyed by tracking error in mm, such as "0", "1" and "2"."""

    db: dict[str, float]  # NaN if the tracking error moves an eye so far that it sees no part of the panels
    standard_error_db: dict[str, float]  # estimated from groups of rows; empty if the sampling has no groups


def expected_quality(
    eye_views: EyeViews, layers: U8, *, sampling: Sampling | None = None, sigmas_mm: Sequence[float] = SIGMAS_MM
) -> Expected:
    """Measure the expected quality of layers for tracking errors, by default light."""
    groups = sampling.groups if sampling else 0
    errors = dict.fromkeys(sigmas_mm, np.full(1 + groups, np.nan))
    with contextlib.suppress(ValueError):
        errors |= expected_errors(
            layers,
            eye_views.wanted,
            eye_views.stack,
            sampling=sampling,
            eyes_m=eye_views.eyes_m,
            fov_deg=eye_views.fov_deg,
            sigmas_mm=sigmas_mm,
        )
    named = {f"{sigma_mm:g}": error for sigma_mm, error in errors.items()}
    standard_errors = {name: standard_error_db(error) for name, error in named.items()} if groups else {}
    return Expected({name: psnr_db(error[0]) for name, error in named.items()}, standard_errors)


def on_panels_raster(picture: P, stack: PanelStack) -> P:
    """Resample a picture to the panels' resolution. A picture with a different aspect ratio keeps it, and
    is reduced if it has more pixels than a panel. Panels cannot show finer detail, and measuring it would cost time and
    memory.
    """
    height_px, width_px = picture.shape[:2]
    size = (stack.width_px, stack.height_px)
    if abs(width_px * stack.height_px / stack.width_px - height_px) > 0.5:
        scale = min(1.0, ((size[0] * size[1]) / (width_px * height_px)) ** 0.5)
        size = (max(round(width_px * scale), 1), max(round(height_px * scale), 1))
    if (width_px, height_px) == size:
        return picture
    resized: Any = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    return resized  # type: ignore[no-any-return]
