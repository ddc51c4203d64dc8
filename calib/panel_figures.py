"""Figures of panel registration and grey curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from calib.figures import COLOURS, finish
from calib.grey import CHANNELS, GreyCurve, Series
from calib.registration import StackRegistration, through
from runtime.optics.stack import PanelStack
from runtime.report.plots import drawing, png

CHANNEL_COLOURS = ("#c0392b", "#27803b", "#2260a8")


def registration_figure(registration: StackRegistration, stack: PanelStack) -> bytes:
    """Each panel's outline, ideal and true, with the displacement enlarged so that it can be seen."""
    shown = [index for index in range(len(registration.panels)) if index != registration.reference]
    with drawing(6 * len(shown), 4.2) as canvas:
        axes = canvas.subplots(ncols=len(shown), squeeze=False)
        width, height = stack.width_px, stack.height_px
        u, v = np.meshgrid(np.linspace(0, width, 9), np.linspace(0, height, 6))
        grid = np.column_stack([u.ravel(), v.ravel()])
        for panel, index in zip(axes[0], shown, strict=True):
            matrix = registration.panels[index].true_from_ideal
            moved = through(matrix, grid) - grid
            largest = max(float(np.linalg.norm(moved, axis=1).max()), 1e-9)
            gain = 0.10 * width / largest
            ends = grid + gain * moved
            corners = np.array([[0, 0], [width, 0], [width, height], [0, height], [0, 0]], dtype=float)
            panel.plot(corners[:, 0], corners[:, 1], color="#999999", linewidth=1, label="ideal")
            true = corners + gain * (through(matrix, corners) - corners)
            panel.plot(true[:, 0], true[:, 1], color="#c0392b", linewidth=1.6, label=f"true, shifts ×{gain:.0f}")
            panel.quiver(
                grid[:, 0], grid[:, 1], *(ends - grid).T, angles="xy", scale_units="xy", scale=1, width=0.003,
                color="#2260a8",
            )  # fmt: skip
            for place, end, shift in zip(corners[:4], true[:4], registration.panels[index].corners_px, strict=True):
                panel.annotate(f"{shift[0]:+.2f}, {shift[1]:+.2f}", end, fontsize=8, ha="center",
                               bbox={"facecolor": "white", "edgecolor": "none", "pad": 1, "alpha": 0.8},
                               va="bottom" if place[1] == 0 else "top", xytext=(0, 5 if place[1] == 0 else -5),
                               textcoords="offset points")  # fmt: skip
            panel.set_title(f"panel {index}")
            panel.margins(0.14)
            panel.invert_yaxis()
            panel.set_aspect("equal", adjustable="datalim")
            panel.set_xlabel("u (px)")
            panel.legend(loc="lower center", bbox_to_anchor=(0.5, 1.06), ncols=2, fontsize=8, frameon=False)
        axes[0][0].set_ylabel("v (px)")
        return png(canvas)


def grey_figure(series: Series, curves: Sequence[GreyCurve]) -> bytes:
    """Measured luminances with the fitted curves, and the LUT."""
    with drawing(10, 4.0) as canvas:
        axes = canvas.subplots(ncols=2)
        greys = np.linspace(0, 1, 400)
        alike = np.ptp(series.luminance, axis=1).max() == 0
        chosen = [0] if alike else [0, 1, 2]
        for channel in chosen:
            colour = "#222222" if alike else CHANNEL_COLOURS[channel]
            name = "grey" if alike else CHANNELS[channel]
            curve = curves[channel]
            axes[0].plot(series.grey, series.luminance[:, channel], "o", color=colour, markersize=4)
            axes[0].plot(greys, curve.dark + curve.span * curve.intensity(greys), color=colour, label=name)
            axes[1].plot(greys, curve.grey(greys), color=colour, label=name)
        axes[1].plot([0, 1], [0, 1], color="#aaaaaa", linestyle=":", label="no correction")
        axes[0].set(xlabel="grey sent to the panel", ylabel="luminance", title="Measured (dots) and fitted")
        axes[1].set(xlabel="phase wanted", ylabel="grey to send", title="The LUT")
        for panel in axes:
            panel.legend(fontsize=8)
        return png(canvas)


def cost_figure(shifts_px: Sequence[float], psnr_db: Mapping[str, Sequence[float]]) -> bytes:
    """Displayed dB against how far a panel is off."""
    with drawing(7, 4.2) as canvas:
        axes = canvas.subplots()
        styles: Any = zip(psnr_db.items(), (*COLOURS[2:], *COLOURS[:2]), strict=False)
        for (name, values), colour in styles:
            axes.plot(shifts_px, values, "o-", color=colour, markersize=4, label=name)
        finish(axes, x="displacement of the panel (px)", y="displayed PSNR (dB)", title="What registration error costs")
        return png(canvas)
