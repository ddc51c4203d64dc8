"""Sections of the report: quality over place, tracking error, gap, resolution and the tolerance knob."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from runtime.report.page import Figure, Section, Table
from runtime.report.plots import COLOURS, drawing, label_points, png
from runtime.report.sweeps import Curve, Size, Tolerance, Volume


def volume_section(volume: Volume, *, model: str, scene: str) -> Section:
    """Where one may stand and sit."""
    with drawing(9.6, 4.4) as figure:
        axes = figure.add_subplot()
        image = _map(axes, volume.psnr_db)
        axes.set_xticks(range(len(volume.angles_deg)), [f"{a:g}" for a in volume.angles_deg])
        axes.set_yticks(range(len(volume.distances_m)), [f"{d:g}" for d in volume.distances_m])
        axes.set(
            xlabel="angle off the axis, degrees",
            ylabel="distance, m",
            title="Displayed PSNR, dB, over the viewer's place",
        )
        figure.colorbar(image, ax=axes, shrink=0.9, pad=0.01)
    counted = volume.psnr_db[np.isfinite(volume.psnr_db)]
    text = [
        f"The scene “{scene}” through the model {model}, with the layers made for each place, both eyes pooled. Blank: "
        "so near and so far aside that an eye would be less than 3 cm before the front panel.",
        f"Over the {counted.size} places: median {np.median(counted):.1f} dB, worst {counted.min():.1f} dB.",
    ]
    caption = "From straight ahead to 70 degrees aside, from 0.1 to 4 m."
    return Section("Across the viewing volume", text, [Figure("viewing-volume", png(figure), caption)])


def tolerance_section(tolerance: Tolerance, *, model: str, distance_m: float) -> Section:
    """How far the eyes may be from where they were believed to be."""
    with drawing(6.4, 5.2) as figure:
        axes = figure.add_subplot()
        image = _map(axes, tolerance.psnr_db)
        names = [f"{o:g}" for o in tolerance.offsets_mm]
        axes.set_xticks(range(len(names)), names)
        axes.set_yticks(range(len(names)), names[::-1])
        axes.set(xlabel="eyes to the right, mm", ylabel="eyes up, mm", title="Displayed PSNR, dB, beside the eyes")
        figure.colorbar(image, ax=axes, shrink=0.9, pad=0.02)
    text = [f"Layers of the model {model} for eyes {distance_m:g} m away, seen by eyes that are really elsewhere."]
    caption = "The middle is exact tracking. A pupil is 4 mm wide, a good tracker off by 2 to 3 mm."
    return Section("Tolerance to tracking errors", text, [Figure("off-eye-map", png(figure), caption)])


def _map(axes: Any, table: Any) -> Any:
    image = axes.imshow(table, cmap="viridis", aspect="auto", interpolation="nearest")
    axes.grid(visible=False)
    finite = table[np.isfinite(table)]
    middle = (finite.min() + finite.max()) / 2 if finite.size else 0.0
    for (row, column), value in np.ndenumerate(table):
        if np.isfinite(value):
            colour = "white" if value < middle else "#1d2433"
            axes.text(column, row, f"{value:.0f}", ha="center", va="center", fontsize=7.5, color=colour)
    return image


def gap_section(curves: Sequence[Curve]) -> Section:
    """Why panels must not stand too close."""
    labels = ("gap between neighbouring panels, mm", "displayed PSNR, dB")
    caption = "The viewer stays equally far from the front panel."
    figure = _curves(curves, "gap-between-panels", labels, caption)
    text = [
        "The outer panels carry the difference between the eyes by their parallax, which grows with the gap: the "
        "smaller the gap, the stiffer the problem, and the less of the difference fits between black and white.",
    ]
    return Section("Quality against panel gap", text, [figure])


def knob_section(curves: Sequence[Curve], *, where: str) -> Section:
    """Exactness against tolerance: a panel a model, all on the same axes."""
    with drawing(9.6, 3.8) as figure:
        panels = figure.subplots(1, len(curves), sharex=True, sharey=True, squeeze=False)[0]
        for axes, curve, colour in zip(panels, curves, COLOURS, strict=False):
            axes.plot(curve.x, curve.y, marker="o", markersize=4.5, color=colour)
            axes.set(xlabel="PSNR exactly at the eyes, dB", title=curve.name)
            axes.margins(0.12, 0.12)
        panels[0].set_ylabel("PSNR 2 mm beside them, dB")
        for axes, curve in zip(panels, curves, strict=True):
            dots = [(x, y, mark) for x, y, mark in zip(curve.x, curve.y, curve.marks, strict=False)]
            label_points(figure, axes, dots, lines=list(zip(curve.x, curve.y, strict=True)))
    text = [
        "The uncertainty of the eyes that is solved for, model.eye_sigma_mm, from 0 to 8 mm "
        f"on {where}: how strongly the outer panels are driven. "
        "What is perfect at one point and useless 2 mm beside it is worth nothing on a real display.",
    ]
    caption = "A dot a setting, its millimetres beside it. To the right: more exact. Up: more tolerant."
    return Section("Exactness against tolerance", text, [Figure("tolerance-knob", png(figure), caption)])


def _curves(curves: Sequence[Curve], name: str, labels: tuple[str, str], caption: str) -> Figure:
    with drawing(9.6, 4.0) as figure:
        axes = figure.add_subplot()
        for curve in curves:
            axes.plot(curve.x, curve.y, marker="o", markersize=4.5, label=curve.name)
        axes.set_xscale("log")
        axes.set_xticks(curves[0].x, [f"{x:g}" for x in curves[0].x], minor=False)
        axes.minorticks_off()
        axes.set(xlabel=labels[0], ylabel=labels[1])
        axes.legend()
    return Figure(name, png(figure), caption)


def resolution_section(sizes: Sequence[Size]) -> Section:
    """What pixels cost."""
    models = list(dict.fromkeys(size.model for size in sizes))
    with drawing(9.6, 4.0) as figure:
        time_axes, quality_axes = figure.subplots(1, 2)
        for colour, model in zip(COLOURS, models, strict=False):
            own = [size for size in sizes if size.model == model]
            pixels = [size.width_px * size.height_px / 1e6 for size in own]
            time_axes.plot(pixels, [size.ms for size in own], marker="o", markersize=4.5, color=colour, label=model)
            quality_axes.plot(pixels, [size.psnr_db for size in own], marker="o", markersize=4.5, color=colour)
        time_axes.set(xlabel="megapixels a panel", ylabel="ms a prediction", ylim=(0, None), title="Time")
        quality_axes.set(xlabel="megapixels a panel", ylabel="displayed PSNR, dB", title="Quality")
        time_axes.legend()
    rows = [[s.model, f"{s.width_px}x{s.height_px}", f"{s.ms:.1f}", f"{s.psnr_db:.2f}"] for s in sizes]
    text = ["The same scene on panels of fewer pixels, each judged at its own resolution."]
    figures = [Figure("resolution", png(figure), "Time and quality over the panels' pixels.")]
    return Section("Resolution", text, figures, [Table(["model", "panels", "ms", "PSNR dB"], rows, folded=True)])
