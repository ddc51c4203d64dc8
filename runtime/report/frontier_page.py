"""Section of the report: the frontier of light against run time, and its table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from runtime.report.frontier import MethodResult, pareto
from runtime.report.page import Figure, Section, Table
from runtime.report.plots import COLOURS, drawing, png

KINDS = {"network": ("o", COLOURS[0]), "iterative": ("s", COLOURS[1])}


def frontier_section(results: Sequence[MethodResult], *, title: str, name: str) -> Section:
    """The plot and the table of one resolution's methods, as far as they are measured."""
    pairs = "; ".join(pair.pair for pair in results[0].pairs)
    text = [
        f"Every method on {pairs}, in one run. Light, the figure to quote: what both eyes make of the panels' pixels, "
        "which are even boxes, for eyes that are sure to 1 mm: a pupil. One ray a pixel, sampled bilinearly, is "
        "what published evaluations measure. The time is that of a whole solution, from two decoded pictures to 8-bit "
        "layers. Each method runs in a process of its own; its memory is that process's peak.",
    ]
    return Section(title, text, [frontier_plot(results, name=f"frontier-{name}")], [method_table(results)])


def frontier_plot(results: Sequence[MethodResult], *, name: str) -> Figure:
    """A curve for each kind of method, more steps to the right."""
    beside: Any = {"textcoords": "offset points", "fontsize": 8.5}
    with drawing(9.6, 5.0) as figure:
        axes = figure.add_subplot()
        for kind, (marker, colour) in KINDS.items():
            dots = sorted((r for r in results if r.kind == kind), key=lambda r: r.ms_p50)
            if dots:
                places = [(r.ms_p50, r.quoted_db) for r in dots]
                axes.plot(*zip(*places, strict=True), marker=marker, markersize=7, color=colour, label=kind)
            for result in dots:  # up and to the left of a curve that rises
                axes.annotate(result.name, (result.ms_p50, result.quoted_db), xytext=(-5, 6), ha="right", **beside)
        axes.set(xscale="log", xlabel="median time of a whole solution, ms", ylabel="light, dB (a pupil)")
        axes.margins(x=0.1, y=0.15)
        axes.set_title("Light against run time: up and to the left is better")
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter("")
        axes.legend()
    return Figure(name, png(figure), "Times hold for this machine and this hour: compare their ratios.")


def method_table(results: Sequence[MethodResult]) -> Table:
    """The numbers, fastest first; times also as multiples of the fastest method's."""
    ordered = sorted(results, key=lambda r: r.ms_p50)
    front = {result.name for result in pareto(results)}
    beside = list(dict.fromkeys(key for result in results for key in result.psnr_db_off_eye))
    headings = ["method", "× fastest", "p50 ms", "p99 ms", "MiB", "parameters", "light 1 mm dB", "0 mm", "2 mm"]
    headings += ["one ray dB", "SSIM", "worst eye", *(f"{key} beside" for key in beside)]
    rows = []
    for r in ordered:
        seen = [r.light_db.get(key) for key in ("1", "0", "2")] + [r.psnr_db, r.ssim, r.worst_eye_psnr_db]
        seen += [r.psnr_db_off_eye.get(key) for key in beside]
        told = ["" if value is None else f"{value:.4g}" for value in seen]
        times = [f"{r.ms_p50 / ordered[0].ms_p50:.1f}", f"{r.ms_p50:.1f}", f"{r.ms_p99:.1f}"]
        rows.append([r.name, *times, f"{r.memory_mib:.0f}", f"{r.parameters:,}", *told])
    size = f"{ordered[0].width_px}x{ordered[0].height_px}"
    styles = ["good" if r.name in front else "" for r in ordered]
    return Table(headings, rows, f"Panels of {size}. Marked: what nothing beats in both time and light.", styles)
