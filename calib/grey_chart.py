"""Measure a panel's grey curve from photographs of a chart; the camera's tone curve may be unknown.

The patches of each grey are scattered over the chart so that uneven illumination can be separated from the greys. Other
patches mix black and white pixels in known proportions. Their intensity does not depend on the panel's grey curve, so
they are used to calibrate the camera. Marks from the calibration board, placed between the patches, are used to locate
the patches in a photograph.

If the other panels are at zero, a panel with phase p between crossed polarizers shows dark + range·sin²(pi/2·p)
(EyeReal, (4)). Photographs cannot show by how much black and full white turn the polarization. Unless these angles are
given (`AngleRange`), black is taken for phase 0 and full white for phase 1.

Each channel of a panel with colour filters has its own curve, measured by the camera's channel of the same colour.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.optimize import least_squares

from calib.board import CORNER, TILE, board, marks
from calib.detect_marks import find_marks
from runtime.errors import InputError
from runtime.optics.malus import phase_from_intensity
from runtime.optics.stack import PanelStack
from runtime.panels.lut import COLUMNS
from runtime.records import F64, U8
from runtime.support.artifacts import write_text

GREYS = tuple(round(255 * step / 12) for step in range(13))
SHARES = tuple(step / 16 for step in (1, 2, 4, 6, 8, 11, 14))  # shares of white pixels in the mixed patches
PATCHES_ACROSS = 32  # number of patches across a panel's width
MARGIN = 0.15  # share of a panel left free at each edge, because the edges look dark from nearby
INNER = 0.5  # share of a patch's side that is measured
SAMPLES = 24  # number of samples along each side of a patch
MIN_MARKS = 4  # minimum number of marks needed to fit the homography from panel to photograph
FALLS = 0.01  # maximum decrease in intensity from a grey to the next brighter one, as a share of the full range
CLIPPED = 0.02  # share of clipped pixels in white patches above which a photograph is overexposed
LUT_ROWS = 256  # one row for each 8-bit phase
BAYER = np.array([[0, 8, 2, 10], [12, 4, 14, 6], [3, 11, 1, 9], [15, 7, 13, 5]])


@dataclass(frozen=True, slots=True)
class AngleRange:
    """Angles by which a panel turns the polarization, measured with an analyser."""

    black_deg: float = 0.0
    white_deg: float = 90.0


@dataclass(frozen=True, slots=True)
class Patch:
    """A square on the chart, either of one grey or with a mixture of black and white pixels."""

    left_px: int
    top_px: int
    side_px: int
    grey: int  # grey from 0 to 255, or -1 for a mixture of black and white pixels
    share: float  # share of white pixels in a mixed patch


@lru_cache(maxsize=8)
def patches(stack: PanelStack, panel: int) -> tuple[Patch, ...]:
    """Lay out the patches of a panel's chart between its board's marks, in random but fixed order."""
    pitch = stack.width_px // PATCHES_ACROSS
    side = pitch * 5 // 6 // 8 * 8  # so that the measured half contains whole periods of the mixing pattern
    free = [
        (left, top)
        for top in range(round(MARGIN * stack.height_px), round((1 - MARGIN) * stack.height_px) - side, pitch)
        for left in range(round(MARGIN * stack.width_px), round((1 - MARGIN) * stack.width_px) - side, pitch)
        if not _is_covered(stack, panel, left, top, side)
    ]
    kinds = [(grey, 0.0) for grey in GREYS] + [(-1, share) for share in SHARES]
    order = np.random.default_rng(panel).permutation(len(free))
    chart = []
    for number, place in enumerate(order.tolist()):
        (left, top), (grey, share) = free[place], kinds[number % len(kinds)]
        chart.append(Patch(left, top, side, grey, share))
    return tuple(chart)


def _is_covered(stack: PanelStack, panel: int, left: int, top: int, side: int) -> bool:
    """Return True if a square overlaps a mark of the panel's board or is too close to one."""
    for mark in marks(stack):
        gap, tile = 2 * mark.unit_px, TILE * mark.unit_px
        u, v = (place - CORNER * mark.unit_px - gap for place in (mark.left_px, mark.top_px))
        reach = tile + 2 * gap
        if mark.panel == panel and u - side < left < u + reach and v - side < top < v + reach:
            return True
    return False


def grey_chart(stack: PanelStack, panel: int) -> U8:
    """Draw a panel's chart (H, W), to show without resampling or LUT while all other panels are at zero."""
    picture = board(stack, panel)
    for patch in patches(stack, panel):
        area = picture[patch.top_px : patch.top_px + patch.side_px, patch.left_px : patch.left_px + patch.side_px]
        if patch.grey >= 0:
            area[:] = patch.grey
        else:
            mixed = np.tile(16 * patch.share > BAYER, (patch.side_px // 4, patch.side_px // 4))
            area[:] = np.where(mixed, 255, 0)
    return picture


def grey_charts(stack: PanelStack, panel: int) -> U8:
    """Return pictures (N, H, W) for all panels, with the chart on one panel and zeros on the others."""
    charts = np.zeros((stack.count, stack.height_px, stack.width_px), np.uint8)
    charts[panel] = grey_chart(stack, panel)
    return charts


def lut_from_photographs(
    out: Path,
    pictures: Iterable[tuple[str, U8]],
    stack: PanelStack,
    *,
    panel: int,
    source: str,
    turns: AngleRange | None = None,
) -> dict[str, Any]:
    """Measure a panel's grey curves from photographs of its chart, and write the LUT as CSV.

    Photographs are names and pixels, grey or RGB. RGB gives a curve for each channel, but one for a panel without
    filters. `turns` are the panel's angles at black and full white, by default 0 and 90 degrees. Raises InputError.
    """
    measured = []
    for name, picture in pictures:
        if picture.ndim == 3 and stack.is_grey(panel):
            picture = np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), np.uint8)
        measured.append(histograms(picture, stack, panel, source=f"{source}, {name}"))
    colours = COLUMNS[1:] if len(measured[0]) == 3 else ("grey",)
    fits = [
        measure([one[channel] for one in measured], stack, panel, source=f"{source}, {colour}")
        for channel, colour in enumerate(colours)
    ]
    intensity, residual = np.squeeze(np.stack([fit for fit, _ in fits], axis=1)), max(error for _, error in fits)
    write_lut(out, intensity, turns or AngleRange())
    return {"file": str(out), "grey": GREYS, "intensity": intensity, "residual": residual}


def write_lut(out: Path, intensity: F64, turns: AngleRange) -> None:
    """Write 256 rows of phase and grey (0 to 1), given the intensities (13,) of `GREYS` from 0 (black) to
    1 (white), or of phase, red, green and blue, given those by channel (13, 3). Phases out of the panel's range get its
    nearest grey.
    """
    rows = np.linspace(0.0, 1.0, LUT_ROWS)
    curves = np.atleast_2d(intensity.T)
    table = np.column_stack([rows, *(_inverted(one, rows, turns) for one in curves)])
    header = COLUMNS if len(curves) == 3 else ("phase", "grey")
    text = "".join(",".join(f"{value:.6f}" for value in row) + "\n" for row in table)
    write_text(out, ",".join(header) + "\n" + text)


def _inverted(intensity: F64, phases: F64, turns: AngleRange) -> F64:
    """Return the greys at which a panel has these phases, given the intensities (13,) of `GREYS`."""
    # The square root of the intensity is smooth at both ends, for bare panels and for monitors with a tone curve.
    root = PchipInterpolator(np.array(GREYS) / 255, np.sqrt(np.maximum.accumulate(intensity)))
    fine = np.linspace(0.0, 1.0, 4097)
    black, white = (float(np.sin(np.radians(angle)) ** 2) for angle in (turns.black_deg, turns.white_deg))
    transmitted = black + (white - black) * np.clip(root(fine), 0.0, 1.0) ** 2
    return np.asarray(np.interp(phases, phase_from_intensity(transmitted, branch=1), fine))


def histograms(picture: U8, stack: PanelStack, panel: int, *, source: str) -> F64:
    """Return histograms (C, P, 256) of the pixels in the middle of each patch, by channel.

    `picture` (h, w) or (h, w, 3) is a photograph of a panel's chart. Raises InputError.
    """
    grey = picture if picture.ndim == 2 else np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), np.uint8)
    picture = np.atleast_3d(picture)
    seen = find_marks(grey, stack, name="")
    mine, marks_seen = seen.panel == panel, seen.marks[panel]
    if marks_seen < MIN_MARKS:
        problem = (
            f"shows only {marks_seen} marks of panel {panel}; check that the picture is sharp and shows the whole "
            "chart of this panel"
        )
        raise InputError(source, "", problem)
    image_from_panel, _ = cv2.findHomography(seen.panel_px[mine], seen.image_px[mine], cv2.RANSAC, 8.0)
    step = (np.arange(SAMPLES) + 0.5) / SAMPLES * INNER + (1 - INNER) / 2
    rows = []
    for patch in patches(stack, panel):
        u, v = np.meshgrid(patch.left_px + step * patch.side_px, patch.top_px + step * patch.side_px)
        places = cv2.perspectiveTransform(np.stack([u, v], axis=-1).reshape(1, -1, 2), image_from_panel)[0]
        column, row = np.rint(places).astype(int).T
        if min(column.min(), row.min()) < 0 or column.max() >= picture.shape[1] or row.max() >= picture.shape[0]:
            raise InputError(source, "", "does not show the whole chart; move back")
        rows.append([np.bincount(channel, minlength=256) / len(row) for channel in picture[row, column].T])
    counts = np.array(rows).transpose(1, 0, 2)
    white = np.array([patch.grey == 255 for patch in patches(stack, panel)])
    if counts[:, white, 253:].sum(axis=2).mean(axis=1).max() > CLIPPED:
        raise InputError(source, "", "is overexposed (white is clipped); reduce the exposure")
    if (counts[:, white] @ np.arange(256)).mean(axis=1).min() < 60:
        raise InputError(source, "", "is too dark; increase the exposure")
    return counts


def measure(pictures: list[F64], stack: PanelStack, panel: int, *, source: str) -> tuple[F64, float]:
    """Estimate the intensities (13,) of `GREYS` from the `histograms` of photographs taken at the same
    exposure.

    The fit determines the camera's tone curve, the uneven illumination in each photograph (its logarithm is modelled as
    a quadratic polynomial in position) and the intensities. Also return the median of the absolute residuals, each
    divided by its patch's intensity (plus 0.02). Raises InputError.
    """
    chart = patches(stack, panel)
    place = np.array([[p.left_px / stack.width_px - 0.5, p.top_px / stack.height_px - 0.5] for p in chart])
    u, v = place.T
    uneven = np.stack([u, v, u * u, u * v, v * v], axis=-1)
    kind = np.array([GREYS.index(p.grey) if p.grey >= 0 else -1 for p in chart])
    share = np.array([p.share for p in chart])
    codes = np.linspace(0.0, 1.0, 256)
    photographs = len(pictures)

    def parts(x: F64) -> tuple[F64, F64, F64, F64]:
        response = codes ** np.exp(x[0]) * np.exp(x[1] * (codes - 1) + x[2] * (codes**2 - 1))
        levels = np.concatenate([[0.0], x[4 : 4 + len(GREYS) - 2], [1.0]])
        dark = x[3]
        light = np.where(kind >= 0, levels[kind], share)
        fields = x[4 + len(GREYS) - 2 :].reshape(photographs, 6)
        return response, dark + (1 - dark) * light, fields, levels

    def residuals(x: F64) -> F64:
        response, light, fields, _ = parts(x)
        relative = []
        for picture, field in zip(pictures, fields, strict=True):
            measured = picture @ response
            expected = np.exp(field[0] + uneven @ field[1:]) * light
            relative.append((measured - expected) / (expected + 0.02))
        return np.concatenate(relative)

    inner = np.array(GREYS[1:-1]) / 255
    start = np.concatenate([[np.log(2.0), 0.0, 0.0, 0.01], inner**2, np.zeros(6 * photographs)])
    fit = least_squares(residuals, start, loss="soft_l1", f_scale=0.05, x_scale="jac", max_nfev=200)
    _, _, _, levels = parts(fit.x)
    falls = np.flatnonzero(np.diff(levels) < -FALLS)
    if falls.size:
        lower, upper = GREYS[int(falls[0])], GREYS[int(falls[0]) + 1]
        problem = f"grey {upper} is darker than grey {lower}"
        causes = "check for reflections, changes in exposure and a wrong LUT"
        raise InputError(source, "greys", f"{problem}; {causes}")
    return np.clip(levels, 0.0, 1.0), float(np.median(np.abs(fit.fun)))
