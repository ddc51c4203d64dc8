"""Evaluate a still solution: compute retina images and quality, and write the result files."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from runtime.evaluation.contact_sheet import contact_sheet, headline
from runtime.evaluation.displayed import SIGMAS_MM, EyeViews, Picture, displayed, expected_quality
from runtime.optics.light import LIGHT, ONE_RAY
from runtime.optics.stack import PanelStack
from runtime.records import F32, U8, Eyes
from runtime.support.artifacts import write_npy, write_png, write_text

BySigma = Mapping[str, float]
GROUPS = 10  # number of row groups used to estimate the standard error of sampled light
WHOLE_PX = 1920 * 1200  # light is measured at every pixel of a picture that has at most this many pixels


@dataclass(frozen=True, slots=True)
class PairQuality:
    """Quality of layers at the eyes they were solved for (docs/contracts.md, Error). Mappings are keyed
    by tracking error in mm: "0", "1", "2". A value is NaN if the tracking error moves an eye so far that it sees no
    part of the panels. SSIM is NaN if it was not requested.
    """

    light_db: BySigma  # with square pixels and a finite pupil; quote "1", a good tracker's tracking error
    expected_db: BySigma  # with one ray per pixel
    psnr_db: float  # with one ray per pixel, at exactly known eyes
    ssim: float
    eye_psnr_db: tuple[float, ...]  # each eye's PSNR, measured like `psnr_db`
    standard_error_db: BySigma = field(default_factory=dict)  # that of `light_db`; empty unless the pixels were sampled

    def table(self) -> dict[str, Any]:
        """Return the entries for solve.json."""
        return {
            "light_db": _rounded(self.light_db),
            "psnr_db": round(self.psnr_db, 3),
            "expected_db": _rounded(self.expected_db),
            "ssim": round(self.ssim, 4),
            "eye_psnr_db": [round(value, 3) for value in self.eye_psnr_db],
        } | ({"standard_error_db": _rounded(self.standard_error_db)} if self.standard_error_db else {})


@dataclass(frozen=True)
class SolvedPair:
    """Layers for several eyes' pictures. The retina images and the quality are computed on first access.
    On first access, ValueError is raised if an eye is behind a panel or sees no part of the panels.
    """

    layers: U8  # (N, h, w, 3 or 4) layers from rear to front
    pictures: Sequence[Picture]  # the target for each eye
    stack: PanelStack
    eyes_m: Eyes  # (V, 3) eye positions, frame `stack`
    fov_deg: float  # the targets' horizontal field of view

    @cached_property
    def eye_views(self) -> EyeViews:
        """The eyes' retina images, and the targets to compare them with."""
        return displayed(self.layers, self.pictures, self.stack, eyes_m=self.eyes_m, fov_deg=self.fov_deg)

    @cached_property
    def quality(self) -> PairQuality:
        """Measured quality. If the pictures have more than `WHOLE_PX` pixels, light is sampled sparsely."""
        height_px, width_px = self.eye_views.wanted[0].shape[:2]
        every = 1 if height_px * width_px <= WHOLE_PX else 4 * math.ceil(height_px / 2160)
        return self._measured(self.eye_views, sigmas_mm=SIGMAS_MM, every=every)

    def sampled(self, *, sigmas_mm: Sequence[float], every: int) -> PairQuality:
        """Measure quality, without SSIM, of every `every`-th pixel and row, with light's standard error."""
        views = displayed(
            self.layers, self.pictures, self.stack, eyes_m=self.eyes_m, fov_deg=self.fov_deg, similarity=False
        )
        return self._measured(views, sigmas_mm=sigmas_mm, every=every)

    def _measured(self, views: EyeViews, *, sigmas_mm: Sequence[float], every: int) -> PairQuality:
        sampling = None if every == 1 else LIGHT._replace(step=every, groups=GROUPS)
        light = expected_quality(views, self.layers, sampling=sampling, sigmas_mm=sigmas_mm)
        rays = expected_quality(views, self.layers, sampling=ONE_RAY._replace(step=every), sigmas_mm=sigmas_mm)
        known = views.quality
        eyes_db = tuple(known.eye_psnr_db)
        return PairQuality(light.db, rays.db, known.psnr_db, known.ssim, eyes_db, light.standard_error_db)

    @property
    def seen(self) -> tuple[U8, ...]:
        """Each eye's retina image, shape (h, w, 3). Pixels whose rays miss a panel are black."""
        return tuple(retina.codes() for retina in self.eye_views.seen)

    def viewer(self, lines: Sequence[str]) -> str:
        """Return an HTML viewer page for the layers, with lines of text below the headline."""
        return self.eye_views.viewer(self.layers, [headline(self.quality.light_db["1"]), *lines])

    def write(self, folder: Path, *, lines: Sequence[str], floats: F32 | None = None) -> None:
        """Write the layers (and `floats`, if given), eye views, contact sheet and viewer page to a folder."""
        for n, layer in enumerate(self.layers):
            write_png(folder / f"layer-{n}.png", layer)
        if floats is not None:
            write_npy(folder / "layers.npy", floats)
        self.eye_views.write(folder)
        sheet = contact_sheet(self.layers, self.eye_views, headline=headline(self.quality.light_db["1"]), lines=lines)
        write_png(folder / "contact-sheet.png", sheet)
        write_text(folder / "viewer.html", self.viewer(lines))


def _rounded(by_sigma: BySigma) -> dict[str, float | None]:
    return {sigma: round(value, 3) if math.isfinite(value) else None for sigma, value in by_sigma.items()}
