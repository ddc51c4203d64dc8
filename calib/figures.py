"""Figures of a calibration as PNG bytes, in the reports' style."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from runtime.optics.stack import PanelStack
from runtime.records import F64
from runtime.report.plots import drawing, png

COLOURS = {"X": "#c0392b", "Y": "#27803b", "Z": "#2260a8"}
GAZE_M = 0.12  # length of the arrow of the camera's line of sight


@dataclass(frozen=True, slots=True)
class Points:
    """The pairs behind a calibration."""

    names: tuple[str, ...]
    stack_m: F64  # (K, 3) known
    fitted_m: F64  # (K, 3) where the calibration puts them, frame `stack`
    used: NDArray[np.bool_]  # (K,)

    @property
    def residual_m(self) -> F64:
        """(K, 3) calibrated minus known."""
        return self.fitted_m - self.stack_m


def residual_figure(points: Points, *, limit_m: float) -> bytes:
    """X, Y, Z error of every calibration point (the EyeReal supplement's figure S5), millimetres."""
    residual_m, used = points.residual_m, points.used
    with drawing(9, 6.5) as canvas:
        axes = canvas.subplots(nrows=3, sharex=True, sharey=True)
        numbers = np.arange(1, len(residual_m) + 1)
        largest = 1e3 * max(float(np.abs(residual_m[used]).max(initial=0.0)), 1e-6)
        for panel, (name, colour), values in zip(axes, COLOURS.items(), residual_m.T * 1e3, strict=True):
            shown = np.clip(values, -2 * largest, 2 * largest)
            panel.vlines(numbers[used], 0, shown[used], color=colour, linewidth=2, label="used")
            panel.vlines(numbers[~used], 0, shown[~used], color="#bbbbbb", linewidth=2,
                         label="rejected (may be cut off)")  # fmt: skip
            rms = float(np.sqrt((values[used] ** 2).mean()))
            panel.axhline(0, color="#222222", linewidth=0.8)
            panel.set(ylabel=f"{name} error (mm)", title=f"{name}: RMS {rms:.2f} mm")
            if limit_m * 1e3 < 2 * largest:
                for limit_mm in (-limit_m * 1e3, limit_m * 1e3):
                    panel.axhline(limit_mm, color="#c0392b", linestyle="--", linewidth=0.8)
        if (~used).any():
            axes[0].legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, fontsize=8, frameon=False)
        axes[-1].set_xlabel("calibration point")
        canvas.suptitle("What the calibration makes of each point, less where it truly was", fontsize=11)
        return png(canvas)


def geometry_figure(stack_from_sensor: F64, stack: PanelStack, points: Points | None) -> bytes:
    """Camera, panels and points from above (x, y) and from the side (x, z); frame `stack`."""
    camera_m = stack_from_sensor[:3, 3]
    tip_m = camera_m + GAZE_M * stack_from_sensor[:3, 2] / np.linalg.norm(stack_from_sensor[:3, 2])
    with drawing(11, 5) as canvas:
        axes = canvas.subplots(ncols=2)
        views = ((1, stack.width_m, "from above", "y: the viewer's right (m)"), (2, stack.height_m, "from the side",
                                                                               "z: up (m)"))  # fmt: skip
        for panel, (axis, size, title, label) in zip(axes, views, strict=True):
            plane = [0, axis]
            for index, x_m in enumerate(stack.x_m):
                name = "panels" if index == 0 else None
                panel.plot([x_m, x_m], [-size / 2, size / 2], color="#2260a8", linewidth=2, label=name)
            if points is not None:
                known, fitted = (values[:, plane] for values in (points.stack_m, points.fitted_m))
                panel.plot(*known[points.used].T, "o", color="none", markeredgecolor="#222222", label="known")
                panel.plot(*fitted[points.used].T, "x", color="#c0392b", label="calibrated")
                if not points.used.all():
                    panel.plot(*fitted[~points.used].T, "x", color="#aaaaaa", label="rejected")
            panel.plot(*camera_m[plane], "s", color="#27803b", markersize=8, label="camera")
            arrow = {"arrowstyle": "->", "color": "#27803b", "linewidth": 1.5}
            panel.annotate("", tip_m[plane], camera_m[plane], arrowprops=arrow)
            panel.set_aspect("equal", adjustable="datalim")
            panel.set(xlabel="x: towards the viewer (m)", ylabel=label, title=f"Seen {title}")
        canvas.legend(*axes[1].get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=8)
        return png(canvas)
