"""Calibration charts with black lines at the thirds of each eye's image (EyeReal, 2.3, S4).

For eyes at the chart's viewpoint, the lines fuse into clean single lines. Elsewhere, ghosts and stripes are visible.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from calib.viewpoints import IPD_M, Viewpoint
from runtime.config import Settings
from runtime.model.predictor import load_predictor
from runtime.model.still import solve_still
from runtime.optics.stack import PanelStack
from runtime.records import F64, U8
from runtime.support.artifacts import OutputFolder, write_json, write_png
from runtime.support.progress import tracked

MODEL = "best"
LINE_PX = 10.0  # line width, in pixels of the eye's image
WIDEST_FOV_DEG = 40.0  # horizontal field of view of the eyes' images, as in the published code


def chart_fov_deg(viewpoint: Viewpoint, stack: PanelStack) -> float:
    """Return the horizontal field of view of the eyes' images at a viewpoint, in degrees. This is the
    published 40 degrees, or the angle that the display fills if that is smaller, so the lines are on the panels at any
    distance.
    """
    return min(WIDEST_FOV_DEG, float(np.degrees(2 * np.arctan(stack.width_m / 2 / (viewpoint.radius_cm / 100)))))


def line_picture(*, width_px: int, height_px: int) -> U8:
    """Draw one eye's picture (h, w, 3), with lines at the thirds of its width and height."""
    ink = np.maximum(_ink(width_px), _ink(height_px)[:, None])
    return np.repeat(np.rint(255 * (1 - ink)).astype(np.uint8)[..., None], 3, axis=2)


def _ink(length_px: int) -> F64:
    """Return the share (length,) of each pixel that is covered by two lines at the thirds of the length."""
    position = np.arange(length_px, dtype=np.float64) + 0.5
    distance = np.minimum(np.abs(position - length_px / 3), np.abs(position - 2 * length_px / 3))
    return np.clip(LINE_PX / 2 - distance + 0.5, 0.0, 1.0)


class Charts:
    """Solver that computes the layers of one stack's charts."""

    def __init__(self, settings: Settings) -> None:
        """Load the model that computes the layers. Raises InputError if it does not fit the stack, or MissingPart."""
        self.stack = settings.stack.stack()
        self.ipd_m = settings.calibration.ipd_m or IPD_M
        self._predictor = load_predictor(MODEL, self.stack, settings.model)

    def layers(self, viewpoint: Viewpoint) -> U8:
        """Compute the layers (N, H, W, 4) that show the lines to both eyes at a viewpoint."""
        picture = line_picture(width_px=self.stack.width_px, height_px=self.stack.height_px)
        eyes_m, fov_deg = viewpoint.eyes_m(self.ipd_m), chart_fov_deg(viewpoint, self.stack)
        prediction = solve_still(picture, picture, eyes_m=eyes_m, fov_deg=fov_deg, predictor=self._predictor)
        return np.array(prediction.layers)  # a copy, because the predictor reuses its array

    def close(self) -> None:
        """Release the model."""
        self._predictor.close()


def make_charts(out: Path, viewpoints: Sequence[Viewpoint], settings: Settings) -> dict[str, Any]:
    """Write each viewpoint's chart as PNG files, and `charts.json`. Raises as `Charts`, and for files."""
    charts = []
    with OutputFolder(out) as folder, closing(Charts(settings)) as drawn:
        for viewpoint in tracked("charts", viewpoints):
            files = [f"chart-{viewpoint.name}-layer-{index}.png" for index in range(drawn.stack.count)]
            for name, layer in zip(files, drawn.layers(viewpoint), strict=True):
                write_png(folder.staging / name, layer)
            charts.append({
                "viewpoint": viewpoint.name,
                "midpoint_m": viewpoint.midpoint_m,
                "eyes_m": viewpoint.eyes_m(drawn.ipd_m),
                "fov_deg": chart_fov_deg(viewpoint, drawn.stack),
                "files": files,
            })  # fmt: skip
        write_json(folder.staging / "charts.json", {"ipd_m": drawn.ipd_m, "model": MODEL, "charts": charts})
    return {"out": str(out), "viewpoints": [v.name for v in viewpoints], "files": len(charts) * drawn.stack.count}
