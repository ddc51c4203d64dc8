"""A section of the report: what a viewer who moves sees."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from runtime.report.moving import Moving
from runtime.report.page import Figure, Section, Table
from runtime.report.plots import COLOURS, drawing, png


def moving_section(found: Sequence[Moving]) -> Section:
    """Light at the true eyes for every motion and solver, as far as measured, with the tracker's error."""
    text = [
        "A solution takes longer than a refresh, and a head does not wait for it: at every refresh the outer panels "
        "are shifted and scaled to where the eyes are when its light leaves. The dB are what the eyes see from where "
        "they truly are, against the picture that the layers were solved for. These are the daemon's own runs on the "
        "simulated clock: refreshes, solver and sensor take the times that are written here, which are configured, not "
        "measured; heads at 0.6 m, 30 samples a second, 3 mm of noise, outliers and dropouts.",
    ]
    headings = ["motion", "solver ms", "light dB", "tracker off p50 mm", "p95 mm", "since solved p50 mm"]
    rows = [
        [one.motion, f"{one.solver_ms:g}", f"{one.light_db:.1f}"]
        + [f"{mm:.1f}" for mm in (*one.tracker_mm, one.behind_mm)]
        for one in found
    ]
    return Section("What a moving viewer sees", text, [moving_plot(found)], [Table(headings, rows)])


def moving_plot(found: Sequence[Moving]) -> Figure:
    """A group of bars a motion, a bar a solver."""
    motions, times = (list(dict.fromkeys(getattr(one, name) for one in found)) for name in ("motion", "solver_ms"))
    with drawing(9.6, 3.6) as figure:
        axes = figure.add_subplot()
        for index, (time, colour) in enumerate(zip(times, COLOURS, strict=False)):
            own = {one.motion: one.light_db for one in found if one.solver_ms == time}
            x = np.arange(len(motions)) + (index - (len(times) - 1) / 2) * 0.3
            bars = axes.bar(x, [own.get(motion, 0.0) for motion in motions], width=0.28, color=colour)
            bars.set_label(f"solver of {time:g} ms")
            axes.bar_label(bars, fmt="%.1f", fontsize=8.5)
        axes.set_xticks(range(len(motions)), motions)
        axes.set(ylabel="light at the true eyes, dB")
        axes.grid(visible=False, axis="x")
        axes.margins(y=0.2)
        axes.legend(ncols=len(times))
    return Figure("moving-viewer", png(figure), "Means of the lights of each run after its first second.")
