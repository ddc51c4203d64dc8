"""Carried, expected and light quality of layers seen from eye positions they were not solved for.

docs/contracts.md defines these measures. Ghosts and colour fringes count as errors. Parallax between the nominal and
the true eye does not count, because no shift of the layers can add it. Neither does the age of the view, which
`evaluation.refresh_quality` measures.
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

PLENTY = 3_000_000  # a picture with more values than this is sampled more sparsely


def carried_db(
    layers: U8,
    drawn: Sequence[U8 | F32],
    stack: PanelStack,
    *,
    solved_for_m: ArrayLike,
    eyes_m: ArrayLike,
    fov_deg: float,
) -> float:
    """Return the PSNR of layers seen from `eyes_m`, one ray per pixel. Raises as `squared_errors`."""
    targets = [intensities(picture) for picture in drawn]
    solved_for, eyes = np.asarray(solved_for_m, np.float64), np.asarray(eyes_m, np.float64)
    errors = squared_errors(
        layers, targets, stack, solved_for_m=solved_for, eyes_m=eyes, fov_deg=fov_deg, sampling=ONE_RAY
    )
    return psnr_db(errors[0])


class AtEyes(TypedDict):
    """Viewing conditions that an expected quality is computed for."""

    eyes_m: ArrayLike  # (V, 3) eyes that the layers were solved for, frame `stack`
    fov_deg: float  # the pictures' horizontal field of view
    sigmas_mm: Sequence[float]  # standard deviations of the tracking error to assume
    seen_from_m: NotRequired[ArrayLike | None]  # (V, 3) true eye positions; by default `eyes_m`


def expected_errors(
    layers: U8,
    drawn: Sequence[U8 | F32],
    stack: PanelStack,
    *,
    sampling: Sampling | None = None,
    **at: Unpack[AtEyes],
) -> dict[float, F64]:
    """Return the squared errors (1 + groups,) to expect for each standard deviation of the tracking, in
    mm.

    The expectation is a weighted sum over five eye positions, which reproduces second moments exactly: weight 1/2
    without tracking error, 1/8 each at two standard deviations to the left and right, above and below. There, only a
    quarter of the rays are traced, at a cost of less than 0.02 dB: every second pixel in every second row of large
    pictures, and two rays across and down each pixel instead of four in others.

    By default, `sampling` is `LIGHT`, the figure to quote, with four times as many rays per pixel if a picture has at
    most `PLENTY` values. Raises ValueError as `squared_errors` does.
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
    """Return the `expected_errors` as PSNRs in dB, keyed by standard deviation in mm."""
    errors = expected_errors(layers, drawn, stack, sampling=sampling, **at)
    return {sigma_mm: psnr_db(error[0]) for sigma_mm, error in errors.items()}


def standard_error_db(errors: F64) -> float:
    """Return a PSNR's standard error in dB, from the errors (1 + groups,) of all rows and of groups."""
    groups = errors[1:]
    relative = float(np.std(groups, ddof=1)) / len(groups) ** 0.5 / max(float(errors[0]), 1e-12)
    return float(10 / math.log(10) * relative)


def intensities(picture: U8 | F32) -> F32:
    """Convert a picture to (h, w, 3) float32 intensities in [0, 1]. Code values are divided by 255."""
    part = picture[..., :3].astype(np.float32)
    if picture.dtype == np.uint8:
        part /= np.float32(255)
    return part
