"""Sections of the report: the frontier of error against run time, and its table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from runtime.report.frontier import MethodResult, pareto
from runtime.report.page import Figure, Section, Table
from runtime.report.plots import COLOURS, drawing, png

KINDS = {"network": ("o", COLOURS[0]), "iterative": ("s", COLOURS[1]), "closed form": ("D", COLOURS[2])}


def frontier_section(results: Sequence[MethodResult], *, pairs: str, title: str, name: str) -> Section:
    """The plot, the plot beside the eyes, and the table of one resolution's methods."""
    front = {id(result) for result in pareto(results)}
    text = [
        f"Every method on {pairs}, in one run. The error is what the eyes see of the displayed layers: clipped, 8 "
        "bits. The time is that of the whole prediction, from two decoded pictures to three 8-bit layers, warps "
        "included. Each method runs in a process of its own; its memory is that process's peak.",
    ]
    figures = [frontier_plot(results, name=f"frontier-{name}")]
    if any(result.psnr_db_off_eye for result in results):
        figures.append(off_eye_plot(results, name=f"off-eye-{name}"))
    return Section(title, text, figures, [method_table(results, front)])


def frontier_plot(results: Sequence[MethodResult], *, name: str) -> Figure:
    """A dot a method, log time, the Pareto front drawn."""
    with drawing(9.6, 5.0) as figure:
        axes = figure.add_subplot()
        front = pareto(results)
        axes.step([r.ms_p50 for r in front], [r.psnr_db for r in front], where="post", color="#9aa3b5", linewidth=1.4)
        for kind, (marker, colour) in KINDS.items():
            own = [r for r in results if r.kind == kind]
            if own:
                axes.scatter(
                    [r.ms_p50 for r in own],
                    [r.psnr_db for r in own],
                    marker=marker,
                    s=64,
                    color=colour,
                    label=kind,
                    zorder=3,
                )
        low, high = min(r.ms_p50 for r in results), max(r.ms_p50 for r in results)
        span = max(r.psnr_db for r in results) - min(r.psnr_db for r in results)
        for result in results:
            near_the_end = result.ms_p50 > low * (high / low) ** 0.85
            _label(axes, result.name, result.ms_p50, result.psnr_db, left=near_the_end)
        axes.set(xscale="log", xlabel="median time of a whole prediction, ms", ylabel="displayed PSNR, dB")
        axes.set(xlim=(low / 1.6, high * 1.6))
        axes.margins(y=0.12 if span else 0.5)
        axes.set_title("Error against run time: up and to the left is better")
        axes.legend(loc="best")
        axes.xaxis.set_major_formatter("{x:g}")
    text = "The line is the Pareto front: methods that no other beats in both time and error."
    return Figure(name, png(figure), text)


def _label(axes: Any, text: str, x: float, y: float, *, left: bool) -> None:
    offset, align = ((-8, 5), "right") if left else ((8, 5), "left")
    axes.annotate(text, (x, y), xytext=offset, textcoords="offset points", ha=align, fontsize=9, color="#1d2433")


def off_eye_plot(results: Sequence[MethodResult], *, name: str) -> Figure:
    """How quickly each method's picture falls apart beside the eyes."""
    with drawing(9.6, 4.2) as figure:
        axes = figure.add_subplot()
        styles = ["-", "--", ":"]
        for index, result in enumerate(results):
            x = [0.0, *(float(key.removesuffix("mm")) for key in result.psnr_db_off_eye)]
            y = [result.psnr_db, *result.psnr_db_off_eye.values()]
            colour = COLOURS[index % len(COLOURS)]
            axes.plot(x, y, marker="o", markersize=4, color=colour, linestyle=styles[index // len(COLOURS) % 3])
            axes.plot([], [], marker="o", markersize=4, color=colour, label=result.name)
        axes.set(xlabel="distance of the eye from where it was believed to be, mm", ylabel="displayed PSNR, dB")
        axes.set_title("Real trackers are off by 2 to 3 mm: what is left of the picture there")
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    text = "Mean over four directions and both eyes, against views drawn anew from there."
    return Figure(name, png(figure), text)


def method_table(results: Sequence[MethodResult], front: set[int]) -> Table:
    """The numbers, fastest first; times also as multiples of the fastest method's."""
    ordered = sorted(results, key=lambda r: r.ms_p50)
    fastest = ordered[0].ms_p50
    distances = list(dict.fromkeys(key for result in results for key in result.psnr_db_off_eye))
    headings = ["method", "kind", "precision", "× fastest", "p50 ms", "p99 ms", "MiB", "parameters", "PSNR dB", "SSIM"]
    headings += ["worst eye dB", *(f"{key} off dB" for key in distances)]
    rows, styles = [], []
    for r in ordered:
        row = [r.name, r.kind, r.precision, f"{r.ms_p50 / fastest:.1f}", f"{r.ms_p50:.1f}", f"{r.ms_p99:.1f}"]
        row += [f"{r.memory_mib:.0f}", f"{r.parameters:,}", f"{r.psnr_db:.2f}", f"{r.ssim:.4f}"]
        row += [f"{r.worst_eye_psnr_db:.2f}"]
        row += [f"{r.psnr_db_off_eye[key]:.2f}" if key in r.psnr_db_off_eye else "" for key in distances]
        rows.append(row)
        styles.append("good" if id(r) in front else "")
    size = f"{ordered[0].width_px}x{ordered[0].height_px}"
    return Table(headings, rows, f"At {size}. Marked: on the Pareto front.", styles)
