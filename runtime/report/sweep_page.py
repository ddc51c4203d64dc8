"""Sections of the report: quality over place, tracking error, gap, resolution and the tolerance knob."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from runtime.report.page import Figure, Section, Table
from runtime.report.plots import COLOURS, drawing, png
from runtime.report.sweeps import Curve, Size, Tolerance, Trade, Volume

SEEN_BY = {0.0: "exact", 1.0: "1 mm: a pupil", 2.0: "2 mm: and a tracker", 4.0: "4 mm"}


def volume_section(volume: Volume, *, model: str, scene: str) -> Section:
    """Where one may stand and sit."""
    with drawing(9.6, 7.8) as figure:
        maps = figure.subplots(2, 1)
        tables = (("exact: two points", volume.psnr_db), ("of a pupil (1 mm)", volume.expected_db))
        for axes, (name, table) in zip(maps, tables, strict=True):
            image = _map(axes, table)
            axes.set_xticks(range(len(volume.angles_deg)), [f"{a:g}" for a in volume.angles_deg])
            axes.set_yticks(range(len(volume.distances_m)), [f"{d:g}" for d in volume.distances_m])
            axes.set(ylabel="distance, m", title=f"Displayed PSNR, dB, {name}, over the viewer's place")
            figure.colorbar(image, ax=axes, shrink=0.9, pad=0.01)
        maps[1].set_xlabel("angle off the axis, degrees")
    exact, expected = (table[np.isfinite(table)] for table in (volume.psnr_db, volume.expected_db))
    text = [
        f"The scene “{scene}” through the model {model}, with the layers made for each place, both eyes pooled. Blank: "
        "so near and so far aside that an eye would be less than 3 cm before the front panel.",
        f"Over the {exact.size} places: exact, median {np.median(exact):.1f} dB, worst {exact.min():.1f} dB; of a "
        f"pupil, median {np.median(expected):.1f} dB, worst {expected.min():.1f} dB. These panels are small: their "
        "pixels are wide, and a pupil loses less by them than on large ones.",
    ]
    caption = "From straight ahead to 70 degrees aside, from 0.1 to 4 m."
    return Section("Across the viewing volume", text, [Figure("viewing-volume", png(figure), caption)])


def tolerance_section(tolerance: Tolerance, *, model: str, distance_m: float) -> Section:
    """How far the eyes may be from where they were believed to be."""
    offsets = np.array(tolerance.offsets_mm, dtype=float)
    step = float(np.diff(offsets)[0])
    low, high = offsets[0] - step / 2, offsets[-1] + step / 2
    with drawing(6.8, 5.8) as figure:
        axes = figure.add_subplot()
        image = _map(axes, tolerance.psnr_db, extent=(low, high, low, high), x=offsets, y=offsets[::-1])
        axes.set(xlabel="eyes to the right, mm", ylabel="eyes up, mm", title="Carried PSNR, dB, beside the eyes")
        axes.set_aspect("equal")
        for radius_mm, name, colour in (
            (1.0, "a pupil (1 mm)", "#ffffff"),
            (2.0, "pupil and tracker (2 mm)", "#ff8c42"),
        ):
            _ring(axes, radius_mm, name, colour)
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=2, fontsize=8.5, facecolor="#3a4357",
                    labelcolor="white", frameon=True)  # fmt: skip
        figure.colorbar(image, ax=axes, shrink=0.9, pad=0.02)
    text = [
        f"Layers of the model {model} for eyes {distance_m:g} m away, seen by eyes that are really elsewhere, against "
        "the picture that the layers were solved for, carried along: what is lost are ghosts and colour fringes.",
    ]
    caption = (
        "The middle is exact tracking. The circles are one standard deviation of where light enters an eye: of a pupil "
        "4 mm wide alone, and of one whose place a good tracker tells."
    )
    return Section("Tolerance to tracking errors", text, [Figure("off-eye-map", png(figure), caption)])


def _ring(axes: Any, radius_mm: float, name: str, colour: str) -> None:
    angle = np.linspace(0, 2 * np.pi, 100)
    x, y = radius_mm * np.cos(angle), radius_mm * np.sin(angle)
    axes.plot(x, y, color="#1d2433", linewidth=2.6)
    axes.plot(x, y, color=colour, linewidth=1.5, label=name)


def _map(axes: Any, table: Any, *, extent: Any = None, x: Any = None, y: Any = None) -> Any:
    """A table as coloured cells with their numbers. extent: of the whole in the axes' units, with the cells' places."""
    image = axes.imshow(table, cmap="viridis", aspect="auto", interpolation="nearest", extent=extent)
    axes.grid(visible=False)
    finite = table[np.isfinite(table)]
    middle = (finite.min() + finite.max()) / 2 if finite.size else 0.0
    for (row, column), value in np.ndenumerate(table):
        if np.isfinite(value):
            colour = "white" if value < middle else "#1d2433"
            place = (column if x is None else x[column], row if y is None else y[row])
            axes.text(*place, f"{value:.0f}", ha="center", va="center", fontsize=7.5, color=colour)
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


def trade_section(trades: Sequence[Trade], *, where: str) -> Section:
    """Exactness against tolerance: what eyes of each uncertainty see, over the one that is solved for."""
    with drawing(9.6, 4.2) as figure:
        panels = figure.subplots(1, len(trades), sharex=True, sharey=True, squeeze=False)[0]
        for axes, trade in zip(panels, trades, strict=True):
            for colour, (sigma_mm, values) in zip(COLOURS, trade.psnr_db.items(), strict=False):
                axes.plot(trade.solved_for_mm, values, marker="o", markersize=4, color=colour, label=SEEN_BY[sigma_mm])
                if values:
                    best = int(np.argmax(values))
                    axes.plot(trade.solved_for_mm[best], values[best], marker="o", markersize=9, markerfacecolor="none",
                              color=colour)  # fmt: skip
            axes.set_xscale("symlog", linthresh=0.5)
            axes.set_xticks(trade.solved_for_mm, [f"{mm:g}" for mm in trade.solved_for_mm])
            axes.minorticks_off()
            axes.set(xlabel="eye_sigma_mm solved for", title=trade.name)
        panels[0].set_ylabel("displayed PSNR, dB")
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=8.5)
    headings = ["model", "solved for, mm", *(SEEN_BY[sigma_mm] + ", dB" for sigma_mm in trades[0].psnr_db)]
    rows = [
        [trade.name, f"{solved_for:g}", *(f"{values[index]:.2f}" for values in trade.psnr_db.values())]
        for trade in trades
        for index, solved_for in enumerate(trade.solved_for_mm)
    ]
    text = [
        f"The uncertainty of the eyes that is solved for, model.eye_sigma_mm, from 0 to 8 mm, on {where}. What is "
        "perfect for two points and falls apart beside them is worth nothing: nobody has such eyes.",
    ]
    caption = "A line for each uncertainty that the eyes really have; a ring where it is served best."
    figures = [Figure("tolerance-knob", png(figure), caption)]
    return Section("Exactness against tolerance", text, figures, [Table(headings, rows, folded=True)])


def _curves(curves: Sequence[Curve], name: str, labels: tuple[str, str], caption: str) -> Figure:
    with drawing(9.6, 4.0) as figure:
        axes = figure.add_subplot()
        for curve, colour in zip(curves, COLOURS, strict=False):
            axes.plot(curve.x, curve.y, marker="o", markersize=4.5, color=colour, label=curve.name)
            if len(curve.expected):
                label = "dashed: of a pupil (1 mm)" if curve is curves[-1] else None
                axes.plot(curve.x, curve.expected, color=colour, linestyle="--", linewidth=1.2, label=label)
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
            quality_axes.plot(pixels, [size.expected_db for size in own], linestyle="--", linewidth=1.2, color=colour)
        time_axes.set(xlabel="megapixels a panel", ylabel="ms a prediction", ylim=(0, None), title="Time")
        quality_axes.set(
            xlabel="megapixels a panel", ylabel="displayed PSNR, dB", title="Quality: exact; dashed: of a pupil (1 mm)"
        )
        time_axes.legend()
    rows = [
        [s.model, f"{s.width_px}x{s.height_px}", f"{s.ms:.1f}", f"{s.psnr_db:.2f}", f"{s.expected_db:.2f}"]
        for s in sizes
    ]
    text = ["The same scene on panels of fewer pixels, each judged at its own resolution."]
    figures = [Figure("resolution", png(figure), "Time and quality over the panels' pixels.")]
    return Section(
        "Resolution",
        text,
        figures,
        [Table(["model", "panels", "ms", "exact dB", "expected 1 mm dB"], rows, folded=True)],
    )
