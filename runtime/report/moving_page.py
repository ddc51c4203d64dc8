"""A section of the report: what a viewer who moves sees, with the panels held and aligned."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from runtime.report.moving import Moving, Strip
from runtime.report.page import Figure, Section, Table
from runtime.report.plots import COLOURS, drawing, png

HELD, ALIGNED = COLOURS[1], COLOURS[0]


def moving_section(found: Sequence[Moving], strip: Strip) -> Section:
    """Carried quality at the true eyes over the solver's time, the tracker's error beside it, and a film strip."""
    motions = list(dict.fromkeys(one.motion for one in found))
    text = [
        "A solution takes longer than a refresh, and a head does not wait for it. Aligned: at every refresh the outer "
        "panels are shifted and scaled to where the eyes are when its light leaves. Held: the layers stay as they were "
        "solved. The dB are carried: what the eyes see from where they really are, against the picture that the layers "
        "were solved for; ghosts and colour fringes count, the parallax that every late picture lacks does not.",
        "These are the daemon's own runs on the simulated clock: 60 refreshes a second, heads at 0.6 m sampled at 30 "
        "Hz with 3 mm of noise, outliers and dropouts, 15 ms from capture to arrival. The rest of the error is the "
        "tracker's own, shown below each motion.",
    ]
    headings = ["motion", "solver ms", "held dB", "aligned dB", "tracker p50 mm", "p95 mm", "eyes since solved, p50 mm"]
    rows = []
    for motion in motions:
        for held, aligned in _pairs(found, motion):
            rows.append(
                [
                    motion,
                    f"{held.solver_ms:g}",
                    f"{held.carried_db:.1f}",
                    f"{aligned.carried_db:.1f}",
                    f"{aligned.tracker_mm[0]:.1f}",
                    f"{aligned.tracker_mm[1]:.1f}",
                    f"{aligned.behind_mm:.1f}",
                ]
            )
    return Section(
        "What a moving viewer sees", text, [moving_plot(found, motions), strip_picture(strip)], [Table(headings, rows)]
    )


def _pairs(found: Sequence[Moving], motion: str) -> list[tuple[Moving, Moving]]:
    """Held and aligned, over the solver's time."""
    own = {(one.solver_ms, one.aligned): one for one in found if one.motion == motion}
    times = sorted({solver_ms for solver_ms, _ in own})
    return [(own[time, False], own[time, True]) for time in times]


def moving_plot(found: Sequence[Moving], motions: Sequence[str]) -> Figure:
    """A column a motion: dB above, millimetres below, over the solver's time."""
    with drawing(9.6, 5.0) as figure:
        axes = figure.subplots(
            2, len(motions), sharex=True, sharey="row", squeeze=False, gridspec_kw={"height_ratios": [2, 1]}
        )
        for upper, lower, motion in zip(*axes, motions, strict=True):
            pairs = _pairs(found, motion)
            times = [held.solver_ms for held, _ in pairs]
            for index, (name, colour, line) in enumerate((("held", HELD, "--"), ("aligned", ALIGNED, "-"))):
                values = [pair[index].carried_db for pair in pairs]
                upper.plot(times, values, marker="o", markersize=4, color=colour, linestyle=line, label=name)
            tracked = np.array([aligned.tracker_mm for _, aligned in pairs])
            lower.plot(times, tracked[:, 0], color=ALIGNED, label="from where the tracker believed them")
            lower.fill_between(times, tracked[:, 0], tracked[:, 1], color=ALIGNED, alpha=0.18)
            behind = [aligned.behind_mm for _, aligned in pairs]
            lower.plot(times, behind, color=HELD, linestyle="--", label="from where the layers were solved for")
            upper.set_title(motion, fontsize=10)
            lower.set_xlabel("solver, ms")
            lower.set_xscale("log")
            lower.set_xticks(times, [f"{time:g}" for time in times])
            lower.minorticks_off()
            lower.tick_params(axis="x", labelsize=8)
        axes[0][0].set_ylabel("carried PSNR at the true eyes, dB")
        axes[1][0].set(ylabel="eyes off, mm", ylim=(0, None))
        handles, labels = axes[0][0].get_legend_handles_labels()
        more, names = axes[1][0].get_legend_handles_labels()
        figure.legend(handles + more, labels + names, loc="outside lower center", ncols=4, fontsize=8.5)
    caption = (
        "Below: how far the eyes were from where they were believed to be; median, and band to its 95th percentile."
    )
    return Figure("moving-viewer", png(figure), caption)


def strip_picture(strip: Strip) -> Figure:
    """Three rows: wanted, held, aligned; a column a refresh."""
    rows = (
        ("wanted", strip.wanted, [""] * len(strip.seconds)),
        ("held", strip.held, [f"{value:.1f} dB" for value in strip.held_db]),
        ("aligned", strip.aligned, [f"{value:.1f} dB" for value in strip.aligned_db]),
    )
    height, width = strip.wanted.shape[1:3]
    part = np.s_[height // 6 : height * 2 // 3, width // 4 : width * 3 // 4]
    columns = len(strip.seconds)
    with drawing(9.6, 0.6 + 3 * (9.2 / columns * height / width + 0.2)) as figure:
        axes = figure.subplots(3, columns, squeeze=False)
        for row, (name, pictures, told) in zip(axes, rows, strict=True):
            for axis, picture, value in zip(row, pictures, told, strict=True):
                axis.imshow(picture[part])
                axis.set(xticks=[], yticks=[])
                axis.grid(visible=False)
                for spine in axis.spines.values():
                    spine.set_visible(False)
                axis.set_xlabel(value, fontsize=8.5)
            row[0].set_ylabel(name)
        for axis, second in zip(axes[0], strip.seconds, strict=True):
            axis.set_title(f"{second:.2f} s", fontsize=9, fontweight="normal")
    caption = (
        f"The left eye of a head whose motion is “{strip.motion}”, with a solver of {strip.solver_ms:g} ms: the middle "
        "of its picture, and both eyes' carried dB."
    )
    return Figure("moving-strip", png(figure), caption)
