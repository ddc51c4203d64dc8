"""Figures of a calibration as PNG bytes, in the reports' style."""

from __future__ import annotations

from typing import Any

import numpy as np

from runtime.optics.stack import PanelStack
from runtime.records import F64
from runtime.report.plots import drawing, png

BARS = 200  # of more points each is a dot
AXES = ("X", "Y", "Z")
COLOURS = ("#c0392b", "#27803b", "#2260a8")


def residual_figure(residual_m: F64, used: Any, *, limit_m: float) -> bytes:
    """X, Y, Z error of every calibration point (the EyeReal supplement's figure S5), millimetres."""
    with drawing(9, 6.5) as canvas:
        axes = canvas.subplots(nrows=3, sharex=True, sharey=True)
        numbers = np.arange(1, len(residual_m) + 1)
        largest = 1e3 * max(float(np.abs(residual_m[used]).max(initial=0.0)), 1e-6)
        for axis, (panel, name) in enumerate(zip(axes, AXES, strict=True)):
            values = residual_m[:, axis] * 1e3
            shown = np.clip(values, -2 * largest, 2 * largest)
            for chosen, colour, label in (
                (used, COLOURS[axis], "used"),
                (~used, "#bbbbbb", "rejected (may be cut off)"),
            ):
                if not chosen.any():
                    continue
                if len(numbers) <= BARS:
                    panel.bar(numbers[chosen], shown[chosen], color=colour, width=0.7, label=label)
                else:
                    panel.plot(numbers[chosen], shown[chosen], ".", color=colour, markersize=1.5, label=label)
            rms = float(np.sqrt((values[used] ** 2).mean()))
            panel.axhline(0, color="#222222", linewidth=0.8)
            panel.set(ylabel=f"{name} error (mm)", title=f"{name}: RMS {rms:.2f} mm")
            if limit_m * 1e3 < 2 * largest:
                panel.axhline(limit_m * 1e3, color="#c0392b", linestyle="--", linewidth=0.8)
                panel.axhline(-limit_m * 1e3, color="#c0392b", linestyle="--", linewidth=0.8)
        if (~used).any():
            axes[0].legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, fontsize=8, frameon=False)
        axes[-1].set_xlabel("calibration point")
        canvas.suptitle("What the calibration makes of each point, less where it truly was", fontsize=11)
        return png(canvas)


def geometry_figure(
    camera_m: F64, gaze: F64, stack: PanelStack, *, points_m: F64 | None, fitted_m: F64 | None, used: Any = None
) -> bytes:
    """Camera, panels and points from above (x, y) and from the side (x, z); frame `stack`."""
    with drawing(11, 5) as canvas:
        axes = canvas.subplots(ncols=2)
        views = ((1, stack.width_m, "from above", "y: the viewer's right (m)"), (2, stack.height_m, "from the side",
                                                                               "z: up (m)"))  # fmt: skip
        for panel, (axis, size, title, label) in zip(axes, views, strict=True):
            for index, x_m in enumerate(stack.x_m):
                name = "panels" if index == 0 else None
                panel.plot([x_m, x_m], [-size / 2, size / 2], color="#2260a8", linewidth=2, label=name)
            if points_m is not None and fitted_m is not None:
                good = points_m[used]
                panel.plot(good[:, 0], good[:, axis], "o", color="none", markeredgecolor="#222222", label="known")
                panel.plot(fitted_m[used][:, 0], fitted_m[used][:, axis], "x", color="#c0392b", label="calibrated")
                if (~used).any():
                    wrong = fitted_m[~used]
                    panel.plot(wrong[:, 0], wrong[:, axis], "x", color="#aaaaaa", label="rejected")
            reach = 0.12
            panel.plot(camera_m[0], camera_m[axis], "s", color="#27803b", markersize=8, label="camera")
            panel.annotate(
                "",
                (camera_m[0] + reach * gaze[0], camera_m[axis] + reach * gaze[axis]),
                (camera_m[0], camera_m[axis]),
                arrowprops={"arrowstyle": "->", "color": "#27803b", "linewidth": 1.5},
            )
            panel.set_aspect("equal", adjustable="datalim")
            panel.set(xlabel="x: towards the viewer (m)", ylabel=label, title=f"Seen {title}")
        canvas.legend(*axes[1].get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=8)
        return png(canvas)
