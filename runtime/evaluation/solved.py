"""A still pair that was solved: what the eyes make of its layers, and the files that tell it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from runtime.evaluation.contact_sheet import contact_sheet, headline
from runtime.evaluation.displayed import EyeViews, Picture, displayed, expected_db
from runtime.optics.light import RAYS
from runtime.optics.retina import as_codes
from runtime.optics.stack import PanelStack
from runtime.records import F64, U8
from runtime.support.artifacts import write_png, write_text

BySigma = Mapping[str, float | None]


@dataclass(frozen=True, slots=True)
class PairQuality:
    """How good what the eyes get is (docs/contracts.md, Error); by "0", "1", "2" mm of eye error; 1: a pupil alone."""

    light_db: BySigma  # of the panels' real pixels; "1" is the figure to quote
    expected_db: BySigma  # one ray a pixel
    psnr_db: float  # one ray a pixel, of two points
    ssim: float
    eye_psnr_db: tuple[float, ...]  # left, right

    def table(self) -> dict[str, Any]:
        """As solve.json has it."""
        return {
            "light_db": _rounded(self.light_db),
            "psnr_db": round(self.psnr_db, 3),
            "expected_db": _rounded(self.expected_db),
            "ssim": round(self.ssim, 4),
            "eye_psnr_db": [round(value, 3) for value in self.eye_psnr_db],
        }


@dataclass(frozen=True, slots=True)
class SolvedPair:
    """Layers, what the eyes see of them, and how good that is."""

    layers: U8  # (N, h, w, 3 or 4), rear to front
    eye_views: EyeViews
    quality: PairQuality

    @property
    def seen(self) -> tuple[U8, ...]:
        """Per eye (h, w, 3): what it sees."""
        return tuple(as_codes(retina.image) for retina in self.eye_views.seen)

    def viewer(self, lines: Sequence[str]) -> str:
        """The page to look into the layers."""
        return self.eye_views.viewer(self.layers, title=headline(self.quality.light_db["1"]), lines=lines)

    def write(self, folder: Path, *, lines: Sequence[str]) -> None:
        """Layers, what each eye sees and should see; contact sheet and viewer with `lines` below their headline."""
        for n, layer in enumerate(self.layers):
            write_png(folder / f"layer-{n}.png", layer)
        self.eye_views.write(folder)
        sheet = contact_sheet(self.layers, self.eye_views, headline=headline(self.quality.light_db["1"]), lines=lines)
        write_png(folder / "contact-sheet.png", sheet)
        write_text(folder / "viewer.html", self.viewer(lines))


def judged(
    layers: U8, pictures: Sequence[Picture], stack: PanelStack, *, eyes_m: F64, fov_deg: float, step: int = 1
) -> SolvedPair:
    """What eyes (2, 3), frame `stack`, make of layers. Raises ValueError where they see nothing of the display.

    step: what is expected of unsure eyes is measured on every so-manieth ray of every so-manieth row alone.
    """
    views = displayed(layers, pictures, stack, eyes_m=eyes_m, fov_deg=fov_deg)
    light, expected = (
        expected_db(views, layers, stack, eyes_m=eyes_m, fov_deg=fov_deg, step=step, rays=rays) for rays in (RAYS, 0)
    )
    at_eyes = views.quality
    quality = PairQuality(light, expected, at_eyes.psnr_db, at_eyes.ssim, tuple(at_eyes.eye_psnr_db))
    return SolvedPair(layers, views, quality)


def _rounded(by_sigma: BySigma) -> dict[str, float | None]:
    return {sigma: None if value is None else round(value, 3) for sigma, value in by_sigma.items()}
