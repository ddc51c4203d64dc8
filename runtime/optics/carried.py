"""Carried, expected and light quality, at eyes other than those solved for (docs/contracts.md).

The picture that the layers were solved for is treated as painted on the centre panel: each pixel's ray is replaced by
the ray from the true eye through the same point of that panel. Ghosts and colour fringes count as errors.
The parallax between nominal and true eye, which no shift of the layers can add, does not count. A stale view is
not counted here; live quality counts it (`evaluation.refresh_quality`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NotRequired, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

from runtime.optics.light import LIGHT, ONE_RAY, Sampling, squared_errors
from runtime.optics.quality import psnr_db
from runtime.optics.stack import PanelStack
from runtime.optics.views import stack_from_eye
from runtime.records import F32, F64, U8

PLENTY = 3_000_000  # pictures with more values than this are sampled more sparsely


def carried_db(
    layers: U8,
    drawn: Sequence[U8 | F32],
    stack: PanelStack,
    *,
    solved_for_m: ArrayLike,
    eyes_m: ArrayLike,
    fov_deg: float,
) -> float:
    """Return the PSNR, with one ray per pixel, at eyes (2, 3) of layers solved for other eyes (2, 3).

    layers: (N, H, W, 3 or 4) code values, exactly as displayed; drawn: an (h, w, 3) picture for each eye of
    `solved_for_m`, as retina pictures of horizontal field of view `fov_deg`, code values or float in [0, 1].
    Raises ValueError for an eye behind a panel, and where the eyes see no part of the panels.
    """
    targets = [intensities(picture) for picture in drawn]
    solved_for, eyes = np.asarray(solved_for_m, np.float64), np.asarray(eyes_m, np.float64)
    errors = squared_errors(
        layers, targets, stack, solved_for_m=solved_for, eyes_m=eyes, fov_deg=fov_deg, sampling=ONE_RAY
    )
    return psnr_db(errors[0])


class AtEyes(TypedDict):
    """Eyes at which an expected quality is measured."""

    eyes_m: ArrayLike  # (2, 3) eyes that the layers were solved for
    fov_deg: float  # field of view of the pictures
    sigmas_mm: Sequence[float]  # tracking errors
    seen_from_m: NotRequired[ArrayLike | None]  # (2, 3) true positions of the eyes; by default the same


def expected_errors(
    layers: U8,
    drawn: Sequence[U8 | F32],
    stack: PanelStack,
    *,
    sampling: Sampling | None = None,
    **at: Unpack[AtEyes],
) -> dict[float, F64]:
    """Expected carried squared error over normal tracking errors, for all rows, then for groups.

    For each standard deviation, to the right and up, it is evaluated at five points: no error with weight 1/2, and two
    standard deviations to either side with weight 1/8 each. This is exact for second moments. drawn: an (h, w, 3)
    picture for each of the eyes (2, 3) that the layers were solved for. sampling: None: light, the figure to quote,
    with four times as many rays a pixel in a picture of fewer values than `PLENTY`. Moved eyes get a quarter of the
    rays, which is exact to 0.02 dB: in a picture of `PLENTY` every second pixel of every second row, otherwise, for
    light, two rays instead of four. Other arguments and errors as for `carried_db`.
    """
    chosen = sampling or (LIGHT if drawn[0].size > PLENTY else LIGHT._replace(rays=2 * LIGHT.rays))
    seen_from_m = at.get("seen_from_m")
    eyes = np.asarray(at["eyes_m"], dtype=np.float64)
    true = eyes if seen_from_m is None else np.asarray(seen_from_m, dtype=np.float64)
    targets = [intensities(picture) for picture in drawn]
    right, up = stack_from_eye(eyes.mean(axis=0))[:3, 0], np.array([0.0, 0.0, 1.0])

    def error(move_m: F64) -> F64:
        return squared_errors(
            layers, targets, stack, solved_for_m=eyes, eyes_m=true + move_m, fov_deg=at["fov_deg"], sampling=chosen
        )

    unmoved = error(np.zeros(3))
    if targets[0].size > PLENTY * chosen.step**2:
        chosen = chosen._replace(step=2 * chosen.step)
    elif chosen.rays > LIGHT.rays:
        chosen = chosen._replace(rays=LIGHT.rays)
    result = {}
    for sigma_mm in at["sigmas_mm"]:
        moves = [side * 2e-3 * sigma_mm * axis for axis in (right, up) for side in (-1, 1)]
        moved = np.sum([error(move) for move in moves], axis=0) / 8 if sigma_mm > 0 else unmoved / 2
        result[sigma_mm] = unmoved / 2 + moved
    return result


def expected_psnrs_db(
    layers: U8,
    drawn: Sequence[U8 | F32],
    stack: PanelStack,
    *,
    sampling: Sampling | None = None,
    **at: Unpack[AtEyes],
) -> dict[float, float]:
    """PSNR of `expected_errors`, by tracking error."""
    errors = expected_errors(layers, drawn, stack, sampling=sampling, **at)
    return {sigma_mm: psnr_db(error[0]) for sigma_mm, error in errors.items()}


def standard_error_db(errors: F64) -> float:
    """Standard error of a PSNR; errors: (1 + groups,) mean squared error of all rows, and of each group."""
    groups = errors[1:]
    relative = float(np.std(groups, ddof=1)) / len(groups) ** 0.5 / max(float(errors[0]), 1e-12)
    return float(10 / math.log(10) * relative)


def intensities(picture: U8 | F32) -> F32:
    """(h, w, 3) float32 intensities in [0, 1] of a picture: code values, or intensities already."""
    part = picture[..., :3].astype(np.float32)
    if picture.dtype == np.uint8:
        part /= np.float32(255)
    return part
