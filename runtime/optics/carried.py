"""What eyes see that are not where the layers were solved for: carried, expected and light quality (docs/contracts.md).

The picture that the layers were solved for is carried along on the centre panel: the ray of each of its pixels is
replaced by the one from the true eye through the same point of that panel. So ghosts and colour fringes count, and
the parallax that a late picture lacks does not.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from runtime.optics.light import RAYS, panels_from_centre, squared_error
from runtime.optics.quality import Quality, psnr_db, quality
from runtime.optics.retina import Rays, Retina, checked_eye, through_layers
from runtime.optics.stack import PanelStack
from runtime.optics.views import stack_from_eye
from runtime.records import F32, F64, U8, U16


class CarriedView:
    """The rays of one nominal eye's picture, which other eyes then look along."""

    def __init__(
        self, nominal_m: ArrayLike, stack: PanelStack, *, width_px: int, height_px: int, fov_deg: float, step: int = 1
    ) -> None:
        """nominal_m: (3,) frame `stack`, whose picture it is; step: only every so-manieth ray of every such row.

        Raises ValueError for an eye that is not before every panel.
        """
        self._stack = stack
        self._rays = Rays.of_eye(
            checked_eye(nominal_m, stack), width_px=width_px, height_px=height_px, fov_deg=fov_deg, step=step
        )

    def seen_from(self, true_m: ArrayLike, layers: U8 | F32) -> Retina:
        """What an eye at (3,) `true_m` sees through the centre panel's points. Raises ValueError as above.

        layers: (N, H, W, 3 or 4), rear to front, code values or float in [0, 1].
        """
        true = checked_eye(true_m, self._stack)
        toward_panels = self._rays.toward_panels()
        return through_layers(layers, lambda rows: self._positions(true, rows), toward_panels, self._stack)

    def _positions(self, true_m: F64, rows: slice) -> Iterable[tuple[F64, F64]]:
        """On every panel: where the lines from the true eye through the centre panel's points cross it (section 3)."""
        centre = self._stack.panel(self._stack.count // 2)
        return [self._rays.on(centre, rows, moved=matrix) for matrix in panels_from_centre(true_m, self._stack)]


def carried_quality(
    layers: U8 | F32,
    drawn: Sequence[U8 | U16 | F32],
    stack: PanelStack,
    *,
    solved_for_m: ArrayLike,
    eyes_m: ArrayLike,
    fov_deg: float,
    step: int = 1,
) -> Quality:
    """Quality at eyes (2, 3) of layers that were solved for others (2, 3), against those others' pictures.

    layers: (N, H, W, 3 or 4), exactly what the panels show; drawn: an (h, w, 3) picture for each eye of
    `solved_for_m`, as retina pictures of horizontal field of view `fov_deg`, code values or float in [0, 1];
    step: only every so-manieth ray of every so-manieth row; SSIM is then NaN, since it wants neighbours.
    Raises ValueError where an eye is not before every panel or sees nothing of them.
    """
    seen, wanted, masks = [], [], []
    for nominal, true, picture in zip(np.asarray(solved_for_m), np.asarray(eyes_m), drawn, strict=True):
        height_px, width_px = picture.shape[:2]
        view = CarriedView(nominal, stack, width_px=width_px, height_px=height_px, fov_deg=fov_deg, step=step)
        retina = view.seen_from(true, layers)
        seen.append(retina.image)
        wanted.append(intensities(picture, step))
        masks.append(retina.mask)
    return quality(seen, wanted, masks, similarity=step == 1)


def expected_psnrs_db(
    layers: U8,
    drawn: Sequence[U8 | U16 | F32],
    stack: PanelStack,
    *,
    eyes_m: ArrayLike,
    fov_deg: float,
    sigmas_mm: Sequence[float],
    seen_from_m: ArrayLike | None = None,
    step: int = 1,
    rays: int = 0,
) -> dict[float, float]:
    """PSNR of the carried squared error expected over normal errors of the eyes' common place (docs/contracts.md).

    For each standard deviation to the right and up, by five points: no error with weight 1/2, two standard deviations
    to either side with 1/8 each, which is exact for second moments. drawn: an (h, w, 3) picture for each of the eyes
    (2, 3) that the layers were solved for; seen_from_m: (2, 3) where they really are, without: there; rays: of light,
    along and down a pixel; 0: one ray, bilinear. The other arguments and errors are those of `carried_quality`.
    """
    eyes = np.asarray(eyes_m, dtype=np.float64)
    true = eyes if seen_from_m is None else np.asarray(seen_from_m, dtype=np.float64)
    targets = [intensities(picture) for picture in drawn]
    right, up = stack_from_eye(eyes.mean(axis=0))[:3, 0], np.array([0.0, 0.0, 1.0])

    def error(move_m: F64) -> float:
        return squared_error(
            layers, targets, stack, solved_for_m=eyes, eyes_m=true + move_m, fov_deg=fov_deg, rays=rays, step=step
        )

    unmoved = error(np.zeros(3))
    result = {}
    for sigma_mm in sigmas_mm:
        moves = [side * 2e-3 * sigma_mm * axis for axis in (right, up) for side in (-1, 1)]
        moved = sum(error(move) for move in moves) / 8 if sigma_mm > 0 else unmoved / 2
        result[sigma_mm] = psnr_db(unmoved / 2 + moved)
    return result


def light_psnrs_db(
    layers: U8, drawn: Sequence[U8 | U16 | F32], stack: PanelStack, *, rays: int = RAYS, **how: Any
) -> dict[float, float]:
    """The same of the light that leaves real pixels (`light`): the figure to quote."""
    return expected_psnrs_db(layers, drawn, stack, rays=rays, **how)


def intensities(picture: U8 | U16 | F32, step: int = 1) -> F32:
    """(h, w, 3) float32 in [0, 1] of every `step`-th pixel of a picture: code values, or intensities already."""
    part = picture[::step, ::step, :3].astype(np.float32)
    if picture.dtype != np.float32:
        part /= np.float32(255 if picture.dtype == np.uint8 else 65535)
    return part
