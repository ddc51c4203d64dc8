"""Sections of the report: the frontier of error against run time, and its table."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from runtime.report.frontier import MethodResult, pareto
from runtime.report.operations import spoken
from runtime.report.page import Figure, Section, Table
from runtime.report.plots import COLOURS, drawing, label_points, png

MEMORY_BOUND_MIB = 1024.0  # of a 1080p prediction
KINDS = {"network": ("o", COLOURS[0]), "iterative": ("s", COLOURS[1]), "closed form": ("D", COLOURS[2])}


def frontier_section(results: Sequence[MethodResult], *, pairs: str, title: str, name: str) -> Section:
    """The plot, what each method costs, the plot away from the eyes, and the table of one resolution's methods."""
    front = {id(result) for result in pareto(results)}
    text = [
        f"Every method on {pairs}, in one run. The error is what the eyes see of the displayed layers: clipped, 8 "
        "bits. Exact: by two points, exactly where the layers were solved for, which is an eye that nobody has. "
        "Expected: the mean squared error over eyes that are unsure by 1 mm (a pupil alone, 4 mm wide) or by 2 mm (a "
        "pupil and a good tracker), against the same picture undisturbed; networks solve for 1 mm.",
        "The time is that of the whole prediction, from two decoded pictures to three 8-bit layers, warps included. "
        "Each method runs in a process of its own; its memory is that process's peak. Multiply-adds are counted, not "
        "measured: products added to a sum, and elementwise arithmetic as one per value.",
    ]
    if any(not result.trained for result in results):
        text.append(
            "The published network (eyereal) has untrained weights here: its time, memory, parameters and "
            "multiply-adds are real, its picture is not, and it has no dot. A trained one is compared by --model FILE."
        )
    if any(result.scale != 1 for result in results):
        text.append("×½: the model works at half the panels' columns and rows, and its layers are enlarged.")
    figures = [frontier_plot(results, name=f"frontier-{name}")]
    if expected := [r for r in results if r.trained and _is_plain(r) and r.expected_db]:
        figures.append(expected_plot(expected, name=f"expected-{name}"))
    figures += [cost_plot(results, name=f"cost-{name}")]
    if any(result.psnr_db_off_eye for result in results):
        figures.append(off_eye_plot([r for r in results if r.trained and _is_plain(r)], name=f"off-eye-{name}"))
    return Section(title, text, figures, [method_table(results, front)])


def frontier_plot(results: Sequence[MethodResult], *, name: str) -> Figure:
    """A dot a method, log time, the Pareto front drawn; a line where there is a time and no picture."""
    with drawing(9.6, 5.4) as figure:
        axes = figure.add_subplot()
        front, dots = pareto(results), [result for result in results if result.trained]
        low, high = min(r.ms_p50 for r in results) / 1.4, max(r.ms_p50 for r in results) * 1.5
        # The front reaches on to the right: who has more time need not take a worse method.
        x, y = [r.ms_p50 for r in front], [r.psnr_db for r in front]
        axes.step([*x, high], [*y, y[-1]], where="post", color="#9aa3b5", linewidth=1.4, label="Pareto front")
        for kind, (marker, colour) in KINDS.items():
            for own, filled in (
                ([r for r in dots if r.kind == kind and _is_plain(r)], True),
                ([r for r in dots if r.kind == kind and not _is_plain(r)], False),
            ):
                if own:
                    axes.scatter(
                        [r.ms_p50 for r in own],
                        [r.psnr_db for r in own],
                        marker=marker,
                        s=60 if filled else 34,
                        color=colour if filled else "white",
                        edgecolors=colour,
                        linewidths=1.3,
                        label=kind if filled else f"{kind}, fewer pixels or bits",
                        zorder=3,
                    )
        axes.set(xscale="log", xlabel="median time of a whole prediction, ms", ylabel="exact displayed PSNR, dB")
        axes.set(xlim=(low, high))
        axes.margins(y=0.1 if np.ptp([r.psnr_db for r in dots]) else 0.5)
        colour = KINDS["network"][1]
        timed_only = sorted((r for r in results if not r.trained), key=lambda r: r.ms_p50)
        for index, result in enumerate(timed_only):
            axes.axvline(result.ms_p50, color=colour, linestyle=":", linewidth=1.4)
            right = index == len(timed_only) - 1  # two lines may be as good as one: their names stand outside
            axes.annotate(
                f"{result.name} (time only)",
                (result.ms_p50, 0.02),
                xycoords=axes.get_xaxis_transform(),
                xytext=(3 if right else -3, 0),
                textcoords="offset points",
                rotation=90,
                ha="left" if right else "right",
                va="bottom",
                fontsize=8.5,
                color=colour,
            )
        axes.set_title("Error against run time: up and to the left is better")
        axes.xaxis.set_major_formatter("{x:g}")
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=5, fontsize=8.5)
        corners = [(x[0], y[0])]
        for ms, psnr_db in zip([*x[1:], high], [*y[1:], y[-1]], strict=True):
            corners += [(ms, corners[-1][1]), (ms, psnr_db)]
        label_points(figure, axes, [(r.ms_p50, r.psnr_db, r.name) for r in dots], lines=corners)
    text = "The line is the Pareto front: methods that no other beats in both time and error."
    return Figure(name, png(figure), text)


def expected_plot(results: Sequence[MethodResult], *, name: str) -> Figure:
    """What an eye sees that is not a point: each method's exact and expected quality over its time, joined."""
    marks = {"exact": "o", "1": "s", "2": "^"}
    words = {"exact": "exact: two points", "1": "1 mm: a pupil", "2": "2 mm: a pupil and a tracker"}
    with drawing(9.6, 5.4) as figure:
        axes = figure.add_subplot()
        for result in results:
            told = {"exact": result.psnr_db} | result.expected_db
            colour = KINDS[result.kind][1]
            axes.plot([result.ms_p50] * len(told), list(told.values()), color=colour, linewidth=1.0, alpha=0.5)
            for key, value in told.items():
                filled = "white" if key == "exact" else colour
                axes.scatter(result.ms_p50, value, marker=marks[key], s=38, color=filled, edgecolors=colour, zorder=3)
        for key, marker in marks.items():
            face = "white" if key == "exact" else "#5b6478"
            axes.scatter([], [], marker=marker, s=38, color=face, edgecolors="#5b6478", label=words[key])
        axes.set(xscale="log", xlabel="median time of a whole prediction, ms", ylabel="displayed PSNR, dB")
        axes.set_title("What an eye sees that is not a point: exact and expected")
        axes.xaxis.set_major_formatter("{x:g}")
        axes.margins(x=0.12, y=0.12)
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=3, fontsize=8.5)
        tops = [(r.ms_p50, max(r.psnr_db, *r.expected_db.values()), r.name) for r in results]
        label_points(figure, axes, tops)
    text = "Blue: networks, orange: iterative, green: closed form. The shorter the line, the more the picture bears."
    return Figure(name, png(figure), text)


def _is_plain(result: MethodResult) -> bool:
    return result.scale == 1 and result.precision == "fp32"


def cost_plot(results: Sequence[MethodResult], *, name: str) -> Figure:
    """Bars of time, memory and multiply-adds, slowest at the top; all three logarithmic."""
    ordered = sorted(results, key=lambda r: r.ms_p50)
    measures = (
        ("median time, ms", [r.ms_p50 for r in ordered]),
        ("peak memory, MiB", [r.memory_mib for r in ordered]),
        ("multiply-adds, 10⁹", [r.multiply_adds / 1e9 for r in ordered]),
    )
    with drawing(9.6, 0.9 + 0.23 * len(ordered)) as figure:
        panels = figure.subplots(1, 3, sharey=True)
        for axes, (label, values) in zip(panels, measures, strict=True):
            axes.barh(range(len(ordered)), values, color=[KINDS[r.kind][1] for r in ordered], height=0.7)
            axes.set(xscale="log", xlabel=label, xlim=(min(values) / 2, max(values) * 6))
            axes.grid(visible=False, axis="y")
            axes.xaxis.set_major_formatter("{x:g}")
            for y, value in enumerate(values):
                axes.annotate(
                    _three_digits(value), (value, y), xytext=(3, 0), textcoords="offset points", va="center", fontsize=8
                )
        panels[0].set_yticks(range(len(ordered)), [r.name for r in ordered])
        panels[1].axvline(MEMORY_BOUND_MIB, color="#5b6478", linestyle="--", linewidth=1.0)
        panels[1].set_title("dashed: 1 GiB", fontsize=9, fontweight="normal")
    return Figure(
        name, png(figure), "Colours as above. Memory: the peak of the method's own process, interpreter and all."
    )


def _three_digits(value: float) -> str:
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def off_eye_plot(results: Sequence[MethodResult], *, name: str) -> Figure:
    """How quickly each method's picture falls apart away from the eyes."""
    with drawing(9.6, 4.2) as figure:
        axes = figure.add_subplot()
        styles = ["-", "--", ":"]
        for index, result in enumerate(results):
            x = [0.0, *(float(key.removesuffix("mm")) for key in result.psnr_db_off_eye)]
            y = [result.psnr_db, *result.psnr_db_off_eye.values()]
            colour = COLOURS[index % len(COLOURS)]
            style = styles[index // len(COLOURS) % len(styles)]
            axes.plot(x, y, marker="o", markersize=4, color=colour, linestyle=style, label=result.name)
        axes.set(xlabel="distance of the eye from where it was believed to be, mm", ylabel="displayed PSNR, dB")
        axes.set_title("Real trackers are off by 2 to 3 mm: what is left of the picture there")
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), handlelength=2.6)
    text = "Mean over four directions and both eyes, against views drawn anew from there."
    return Figure(name, png(figure), text)


def method_table(results: Sequence[MethodResult], front: set[int]) -> Table:
    """The numbers, fastest first; times also as multiples of the fastest method's."""
    ordered = sorted(results, key=lambda r: r.ms_p50)
    fastest = ordered[0].ms_p50
    distances = list(dict.fromkeys(key for result in results for key in result.psnr_db_off_eye))
    headings = ["method", "kind", "precision", "× fastest", "p50 ms", "p99 ms", "MiB", "parameters"]
    sigmas = list(dict.fromkeys(key for result in results for key in result.expected_db))
    headings += ["10⁹ multiply-adds", "PSNR dB", *(f"expected {key} mm dB" for key in sigmas), "SSIM"]
    headings += ["worst eye dB", *(f"{key} off dB" for key in distances)]
    rows, styles = [], []
    for r in ordered:
        row = [r.name, r.kind, r.precision, f"{r.ms_p50 / fastest:.1f}", f"{r.ms_p50:.1f}", f"{r.ms_p99:.1f}"]
        row += [f"{r.memory_mib:.0f}", f"{r.parameters:,}", spoken(r.multiply_adds)]
        expected = [f"{r.expected_db[key]:.2f}" if key in r.expected_db else "" for key in sigmas]
        seen = [f"{r.psnr_db:.2f}", *expected, f"{r.ssim:.4f}", f"{r.worst_eye_psnr_db:.2f}"]
        seen += [f"{r.psnr_db_off_eye[key]:.2f}" if key in r.psnr_db_off_eye else "" for key in distances]
        row += seen if r.trained else [""] * len(seen)
        rows.append(row)
        styles.append("good" if id(r) in front else "")
    size = f"{ordered[0].width_px}x{ordered[0].height_px}"
    return Table(headings, rows, f"Panels of {size}. Marked: on the Pareto front.", styles)
