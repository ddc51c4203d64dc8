"""Draw contact sheets that show the layers and each eye's target, retina image and error."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from textwrap import wrap

import cv2
import numpy as np

from runtime.evaluation.displayed import EyeViews, eye_names
from runtime.optics.carried import intensities
from runtime.optics.focus import FocusTargets
from runtime.optics.pupil import PUPIL_MM, TRACKING_SIGMA_MM
from runtime.optics.retina import as_codes
from runtime.records import F32, U8, Eyes, RefreshAccount

TILE_WIDTH = 640  # pixels
MARGIN = 12  # pixels
LINE_LETTERS = 58  # number of letters per line under the headline, for each tile of the sheet's width
HEADLINE, TITLE = 52, 34  # heights in pixels
ERROR_GAIN = 8  # amplification factor for the error pictures
INK = (40, 40, 40)  # text colour
PAPER = 246  # background grey level


@dataclass(frozen=True, slots=True)
class Moment:
    """A measured refresh, with aligned layers for the contact sheet and the solution for the viewer."""

    layers: U8  # (N, h, w, 3 or 4) layers as shown by the panels, after alignment
    eye_views: EyeViews
    light_db: float  # light PSNR for a tracking error of 1 mm
    lines: tuple[str, ...]  # text that states the refresh number and how far the eyes had moved
    solution: U8  # (N, h, w, 3 or 4) layers before alignment
    solved_for_m: Eyes  # (2, 3) eyes the solution was computed for, frame `stack`
    asked_for: tuple[U8, ...]  # (h, w, 3) the solution's targets
    relief: F32 | None = None  # (h, w) relief of the solution's content (`optics.relief`)
    account: RefreshAccount | None = None  # the refresh
    # Retina pictures of the scene and, as seen through the layers, in the same order, if the solution has focus
    focused: tuple[FocusTargets, tuple[U8, ...]] | None = None
    state_version: int = 0  # the solver's state at the refresh (`Facts.version`)


def contact_sheet(
    layers: U8,
    eye_views: EyeViews | None,
    *,
    headline: str,
    lines: Sequence[str] = (),
    focused: tuple[FocusTargets, tuple[U8, ...]] | None = None,
) -> U8:
    """Draw a sheet (h, w, 3): a row of layers, each eye's target, retina image and error, and what
    the left eye sees as it focuses (`Moment.focused`).
    """
    height, width = layers.shape[1:3]
    tile = (TILE_WIDTH, round(TILE_WIDTH * height / width))
    names = {0: "layer 0 (rear, at the backlight)", len(layers) - 1: f"layer {len(layers) - 1} (front)"}
    rows = [[(names.get(n, f"layer {n}"), np.ascontiguousarray(layers[n, ..., :3])) for n in range(len(layers))]]
    if eye_views is not None:
        for side, name in enumerate(eye_names(len(eye_views.seen))):
            side_name, _, viewer = name.partition("-")
            eye = f"{side_name} eye of viewer {viewer}" if viewer else f"{side_name} eye"
            seen = eye_views.seen[side]
            target = intensities(eye_views.wanted[side])
            shown = np.where(seen.mask[..., None], seen.image, 0.94)
            error = np.where(seen.mask[..., None], np.abs(seen.image - target) * ERROR_GAIN, 0.94)
            rows.append(
                [
                    (f"{eye}: target", as_codes(target)),
                    (f"{eye}: seen through the layers", as_codes(shown)),
                    (f"{eye}: error x {ERROR_GAIN} (black is perfect)", as_codes(error)),
                ]
            )
    if focused is not None:
        scene, through = focused
        for name, pictures in (("seen through the layers", through), ("the scene's own", scene.pictures)):
            focus = [f"left eye focused at {1000 * plane_m:+.0f} mm" for plane_m in scene.planes_m]
            rows.append([(f"{where}: {name}", left) for where, left in zip(focus, pictures[::2], strict=True)])
    columns = max(len(row) for row in rows)
    lines = [part for line in lines for part in wrap(line, LINE_LETTERS * columns)]
    cell = (tile[0] + MARGIN, tile[1] + MARGIN + TITLE)
    head = HEADLINE + TITLE * len(lines)
    sheet = np.full((head + MARGIN + cell[1] * len(rows), MARGIN + cell[0] * columns, 3), PAPER, np.uint8)
    _write(sheet, headline, x=MARGIN, y=HEADLINE - 14, scale=1.0)
    for n, line in enumerate(lines):
        _write(sheet, line, x=MARGIN, y=HEADLINE + TITLE * (n + 1) - 12, scale=0.62)
    for r, row in enumerate(rows):
        for c, (title, picture) in enumerate(row):
            x, y = MARGIN + c * cell[0], head + r * cell[1]
            _write(sheet, title, x=x, y=y + TITLE - 8, scale=0.55)
            small = cv2.resize(picture, tile, interpolation=cv2.INTER_AREA)
            sheet[y + TITLE : y + TITLE + tile[1], x : x + tile[0]] = small
    return sheet


def headline(light_db: float | None) -> str:
    """Return a headline with the light PSNR for a tracking error of 1 mm, None or NaN if unknown."""
    if light_db is None or math.isnan(light_db):
        return "light PSNR at these eyes was not measured"
    conditions = f"pixels as squares, pupil {PUPIL_MM:g} mm, tracking error {TRACKING_SIGMA_MM:g} mm"
    return f"PSNR {light_db:.1f} dB at the eyes ({conditions})"


def _write(sheet: U8, text: str, *, x: int, y: int, scale: float) -> None:
    cv2.putText(sheet, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, scale, INK, 1, cv2.LINE_AA)
