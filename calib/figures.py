"""Figures of a calibration as PNG bytes, in the reports' style."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from calib.experiment import Case, Timing
from runtime.optics.stack import PanelStack
from runtime.records import F64
from runtime.report.plots import drawing, png

BARS = 200  # of more points each is a dot
AXES = ("X", "Y", "Z")
COLOURS = ("#c0392b", "#27803b", "#2260a8", "#c77d0a", "#6b3fa0", "#222222")


def finish(axes: Any, *, x: str, y: str, title: str) -> None:
    """Name the axes of a plot of lines, and give it a legend."""
    axes.set(xlabel=x, ylabel=y, title=title)
    axes.legend(fontsize=8)


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


def eye_error_figure(distances_m: F64, straight_m: F64, aside_m: F64) -> bytes:
    """Expected error at the eye against distance, straight ahead and 25 degrees aside, millimetres."""
    with drawing(6.5, 3.6) as canvas:
        axes = canvas.subplots()
        axes.plot(distances_m, straight_m * 1e3, color="#2260a8", label="straight ahead")
        axes.plot(distances_m, aside_m * 1e3, color="#c0392b", linestyle="--", label="25° to the side")
        axes.set_ylim(bottom=0)
        title = "What the calibration's own uncertainty does at the eye"
        finish(axes, x="distance of the eyes (m)", y="expected error (mm)", title=title)
        return png(canvas)


def methods_figure(cases: Sequence[Case], *, title: str) -> bytes:
    """Mean and 95th percentile of the error at the eye against noise, for each method."""
    names = list(cases[0].mean_m)
    noisy = [case for case in cases if case.sigma_m > 0]
    with drawing(13, 4.2) as canvas:
        axes = canvas.subplots(ncols=3)
        axes[0].sharey(axes[1])
        kinds = (("mean_m", "mean"), ("p95_m", "95th percentile"), ("mean_m", "mean, over the default's"))
        for panel, (figures, label) in zip(axes, kinds, strict=True):
            relative = panel is axes[2]
            for name, colour in zip(names, COLOURS, strict=False):
                values = [
                    getattr(case, figures)[name] / (case.mean_m["default"] if relative else 1e-3) for case in noisy
                ]
                style = {"color": colour, "marker": "o", "markersize": 4, "label": name, "linewidth": 1.3}
                if name == "default":
                    style |= {"linewidth": 4, "alpha": 0.25, "marker": "", "zorder": 0}
                panel.plot([case.sigma_m * 1e3 for case in noisy], values, **style)
            panel.set_xscale("log")
            panel.set_yscale("log")
            if relative and panel.get_ylim()[1] < 15:
                panel.set_yscale("linear")
            panel.set_xticks([case.sigma_m * 1e3 for case in noisy], [f"{case.sigma_m * 1e3:g}" for case in noisy])
            panel.set(xlabel="noise of each sensor coordinate (mm)", title=label)
        axes[0].set_ylabel("error at the eye (mm)")
        axes[2].set_ylabel("times the default's error")
        axes[0].legend(fontsize=8)
        canvas.suptitle(title, fontsize=11)
        return png(canvas)


def timing_figure(timings: Sequence[Timing]) -> bytes:
    """Error at the eye against run time; each point a number of pairs."""
    with drawing(7, 4.3) as canvas:
        axes = canvas.subplots()
        for name, colour in zip(dict.fromkeys(t.method for t in timings), COLOURS[1:], strict=False):
            chosen = [t for t in timings if t.method == name]
            axes.plot(
                [t.ms_p50 for t in chosen],
                [t.error_m * 1e3 for t in chosen],
                "o-",
                color=colour,
                label=name,
                markersize=4,
            )
            for t in chosen:
                axes.annotate(f"{t.pairs:,}", (t.ms_p50, t.error_m * 1e3), fontsize=7, xytext=(4, 4),
                              textcoords="offset points")  # fmt: skip
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.margins(x=0.12)
        title = "Error against run time; numbers: pairs; noise 3 mm"
        finish(axes, x="time of one solution (ms)", y="mean error at the eye (mm)", title=title)
        return png(canvas)
