"""Carried, expected and light quality of layers seen by other eyes than they were solved for.

These measures are defined in docs/contracts.md. The picture that the layers were solved for is treated as painted on
the centre panel: each pixel's ray is replaced by the ray from the true eye through the same point of that panel. Ghosts
and colour fringes count as errors. The parallax between the nominal and the true eye does not count, because no shift
of the layers can add it. The age of the view does not count either; `evaluation.refresh_quality` measures it.
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
    """Return the PSNR at `eyes_m` (2, 3) of layers solved for `solved_for_m` (2, 3), one ray per pixel.

    layers: (N, H, W, 3 or 4) code values, exactly as displayed; drawn: an (h, w, 3) retina picture for each eye of
    `solved_for_m`, `fov_deg` wide, as code values or float in [0, 1].
    Raises ValueError for an eye behind a panel, or if the eyes see no part of the panels.
    """
    targets = [intensities(picture) for picture in drawn]
    solved_for, eyes = np.asarray(solved_for_m, np.float64), np.asarray(eyes_m, np.float64)
    errors = squared_errors(
        layers, targets, stack, solved_for_m=solved_for, eyes_m=eyes, fov_deg=fov_deg, sampling=ONE_RAY
    )
    return psnr_db(errors[0])


class AtEyes(TypedDict):
    """Eyes, field of view and tracking errors for which an expected quality is computed."""

    eyes_m: ArrayLike  # (2, 3) eyes that the layers were solved for
    fov_deg: float  # horizontal field of view of the pictures
    sigmas_mm: Sequence[float]  # standard deviations of the tracking error
    seen_from_m: NotRequired[ArrayLike | None]  # (2, 3) true positions of the eyes; by default `eyes_m`


def expected_errors(
    layers: U8,
    drawn: Sequence[U8 | F32],
    stack: PanelStack,
    *,
    sampling: Sampling | None = None,
    **at: Unpack[AtEyes],
) -> dict[float, F64]:
    """Return the carried squared errors expected for normal tracking errors, by standard deviation.

    Each value is an array: the error of all rows, then of each group of rows. The expectation is a sum over five
    points, which is exact for second moments: no tracking error with weight 1/2, and two standard deviations left,
    right, up and down with weight 1/8 each.

    drawn: an (h, w, 3) picture for each of the eyes (2, 3) that the layers were solved for. sampling: by default the
    one for light, the figure to quote, with four times as many rays per pixel in pictures of at most `PLENTY` values.
    Moved eyes are sampled with a quarter of the rays, which costs less than 0.02 dB: larger pictures use every second
    pixel of every second row, others use two rays across and down each pixel instead of four. The other arguments and
    the exceptions are those of `carried_db`.
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
    """Return the PSNRs of `expected_errors` in dB, keyed by the tracking error's standard deviation."""
    errors = expected_errors(layers, drawn, stack, sampling=sampling, **at)
    return {sigma_mm: psnr_db(error[0]) for sigma_mm, error in errors.items()}


def standard_error_db(errors: F64) -> float:
    """Return the standard error in dB of the PSNR that belongs to the first of these errors.

    errors: (1 + groups,) squared errors of all rows, then of each group of rows.
    """
    groups = errors[1:]
    relative = float(np.std(groups, ddof=1)) / len(groups) ** 0.5 / max(float(errors[0]), 1e-12)
    return float(10 / math.log(10) * relative)


def intensities(picture: U8 | F32) -> F32:
    """Convert a picture of code values or intensities to (h, w, 3) float32 intensities in [0, 1]."""
    part = picture[..., :3].astype(np.float32)
    if picture.dtype == np.uint8:
        part /= np.float32(255)
    return part
