"""Sections on the report page: light against run time, live quality in motion, and focal parallax."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from runtime.report.focal import CARDS_M, DISTANCE_M, PUPIL_M, FocalStack
from runtime.report.frontier import QUOTED, SHIPPED, MethodResult
from runtime.report.moving import COSTS_MS, FIXED, NOISE_MM, SECONDS, SEED, Moving
from runtime.report.page import Figure, PageSection, Table, drawing, png

KINDS = {"shipped": ("o-", "C0"), "added": ("D", "C2"), "iterative": ("s-", "C1")}
NAMES = ("behind the panels", "in the middle panel", "in front of the panels")


def frontier_section(results: Sequence[MethodResult], *, title: str, name: str) -> PageSection:
    """Return a section with a plot and a table of methods so far at one resolution."""
    pairs = "; ".join(pair.pair for pair in results[0].pairs)
    text = [
        f"Every method was measured on {pairs} in one run. Quote the light PSNR, which assumes square panel pixels, "
        "pupils 4 mm wide and a tracking error of 1 mm. Published evaluations trace one ray per pixel, sampled "
        "bilinearly. The time covers a whole solution, from two decoded pictures to 8-bit layers. Each method runs in "
        "a separate process, and its memory is the peak of that process."
    ]
    links = [(f"Viewer: {pair.pair}, {results[0].name}", pair.viewer) for pair in results[0].pairs if pair.viewer]
    return PageSection(title, text, [frontier_plot(results, name=f"frontier-{name}")], [method_table(results)], links)


def frontier_plot(results: Sequence[MethodResult], *, name: str) -> Figure:
    """Plot light against median run time for all methods, in a figure called `name`.

    Shipped models form one curve and the iterative references another; added models are shown as single points. Each
    curve leaves out any method that is slower than another method on that curve and no better. Bars span the 10th to
    90th percentiles of the run times, and each small dot is a single pair.
    """
    beside: Any = {"textcoords": "offset points", "fontsize": 8.5}
    with drawing(9.6, 5.0) as figure:
        axes = figure.add_subplot()
        for kind, (style, colour) in KINDS.items():
            dots = sorted((r for r in results if kind_of(r) == kind), key=lambda r: r.ms_p50)
            if dots:
                places = [(r.ms_p50, r.quoted_db) for r in dots]
                curve = rising(places) if style.endswith("-") else places
                axes.plot(*zip(*curve, strict=True), style, markersize=7, color=colour, label=kind)
                if aside := [place for place in places if place not in curve]:
                    axes.plot(*zip(*aside, strict=True), style[0], markersize=7, color=colour)
                for place, (low_ms, high_ms) in zip(places, [r.spread_ms for r in dots], strict=True):
                    axes.barh(place[1], high_ms - low_ms, left=low_ms, height=0.25, color=colour, alpha=0.3)
            of_pairs = [(float(np.median(pair.run_ms)), pair.quality.light_db) for r in dots for pair in r.pairs]
            if len(of_pairs) > len(dots):
                seen = [(ms, light_db.get(QUOTED, np.nan)) for ms, light_db in of_pairs]
                axes.scatter(*zip(*seen, strict=True), s=9, color=colour, alpha=0.5, linewidths=0)
            for result in dots:  # names go above and to the left of the points, where a rising curve never passes
                axes.annotate(result.name, (result.ms_p50, result.quoted_db), xytext=(-5, 6), ha="right", **beside)
        axes.set(xscale="log", xlabel="median time of a whole solution, ms", ylabel="light, dB (tracking error 1 mm)")
        axes.use_sticky_edges = False  # bars have sticky edges, which would suppress the margins
        axes.margins(x=0.1, y=0.15)
        axes.set_title("Light against run time: up and to the left is better")
        axes.xaxis.get_major_locator().set_params(subs=(1.0, 2.0, 5.0))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter("")
        axes.legend()
    told = "Times depend on this machine and its load; compare ratios. Bars: eight runs in ten. Dots: single pairs."
    return Figure(name, png(figure), told)


def rising(places: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return the (time, dB) points whose quality is higher than that of all faster points, fastest first."""
    found: list[tuple[float, float]] = []
    for place in sorted(places):
        if not found or place[1] > found[-1][1]:
            found.append(place)
    return found


def kind_of(result: MethodResult) -> str:
    """Return the key in KINDS that determines a result's curve and style."""
    return "shipped" if result.name in SHIPPED else "added" if result.kind in ("network", "layers") else result.kind


def method_table(results: Sequence[MethodResult]) -> Table:
    """Return a table of all results, sorted by time. Times are also given as multiples of the fastest."""
    ordered = sorted(results, key=lambda r: r.ms_p50)
    beside = list(dict.fromkeys(key for result in results for key in result.psnr_db_off_eye))
    headings = ["method", "× fastest", "p50 ms", "p99 ms", "MiB", "parameters", "light 1 mm dB", "0 mm", "2 mm"]
    headings += ["one ray dB", "SSIM", "one ray, worst eye dB"]
    headings += [f"one ray, eyes {key.removesuffix('mm')} mm off, dB" for key in beside]
    rows = []
    for r in ordered:
        seen = [r.light_db.get(key) for key in ("1", "0", "2")] + [r.psnr_db, r.ssim, r.worst_eye_psnr_db]
        seen += [r.psnr_db_off_eye.get(key) for key in beside]
        told = ["" if value is None else f"{value:.4g}" for value in seen]
        times = [f"{r.ms_p50 / ordered[0].ms_p50:.1f}", f"{r.ms_p50:.1f}", f"{r.ms_p99:.1f}"]
        costs = ["", ""] if r.kind == "layers" else [f"{r.memory_mib:.0f}", f"{r.parameters:,}"]
        rows.append([r.name, *times, *costs, *told])
    size = f"{ordered[0].width_px}x{ordered[0].height_px}"
    caption = f"Panels have {size}. The worst eye is the worst of all pairs with one ray per pixel."
    return Table(headings, rows, caption)


def moving_section(found: Sequence[Moving]) -> PageSection:
    """Return a section with the live quality and view error for each motion and effort measured."""
    costs = ", ".join(f"{stage} {ms}" for stage, ms in COSTS_MS.items())
    text = [
        "A solution takes longer than a refresh, and the head keeps moving. At every refresh, the outer panels are "
        "shifted and scaled to the eyes, which removes ghosts but does not update the view. Live quality measures "
        "both: it compares the light at the true eyes with what they should see at that refresh. The view error is the "
        "distance from the true eyes to the eyes that the layers were solved for.",
        "An effort is a raster and a number of steps: 1/2+1 has half the rows and columns and one step. A fixed effort "
        "applies to every solution; with auto, the loop chooses. The daemon ran on the simulated clock, on which a "
        f"solution at the full raster takes these times in ms: {costs}. Coarser rasters take less in proportion to "
        f"their pixels. The head was at 0.6 m, with 30 samples per second, {NOISE_MM} mm of noise, outliers and "
        f"dropouts, for {SECONDS:g} s with seed {SEED}. In the motion film, the content moves and the head rests.",
    ]
    headings = ["motion", "effort", "live dB", "view error p50 mm", "p95 mm", "on the panels"]
    rows = [
        [one.motion, one.effort, f"{one.live_db:.1f}", *(f"{mm:.1f}" for mm in one.view_error_mm), most_used(one)]
        for one in found
    ]
    return PageSection("What a moving viewer sees", text, [moving_plot(found)], [Table(headings, rows)])


def most_used(one: Moving) -> str:
    """Return the efforts in use for at least a tenth of the time, with percentages, longest first."""
    seconds = sorted(one.efforts.items(), key=lambda item: -item[1])
    total_s = sum(one.efforts.values())
    return ", ".join(f"{name} {100 * s / total_s:.0f}%" for name, s in seconds if s >= total_s / 10)


def moving_plot(found: Sequence[Moving]) -> Figure:
    """Plot each motion's live quality and view error, with lines for fixed efforts and stars for `auto`."""
    motions = list(dict.fromkeys(one.motion for one in found))
    efforts = [*(effort.name for effort in FIXED), "auto"]
    with drawing(9.6, 6.4) as figure:
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
        for axes, values in ((above, [one.live_db for one in found]), (below, [one.view_error_mm[0] for one in found])):
            for number, motion in enumerate(motions):
                own = {one.effort: value for one, value in zip(found, values, strict=True) if one.motion == motion}
                if fixed := [(x, own[name]) for x, name in enumerate(efforts) if name in own and name != "auto"]:
                    axes.plot(*zip(*fixed, strict=True), "o-", color=f"C{number}", markersize=5, label=motion)
                if "auto" in own:
                    label = None if fixed else motion  # while the page grows, fixed efforts may not be measured yet
                    axes.plot(len(FIXED), own["auto"], "*", color=f"C{number}", markersize=13, label=label)
                    axes.axhline(own["auto"], color=f"C{number}", linewidth=0.8, linestyle=":")
        above.set(ylabel="live quality, dB")
        above.legend(ncols=len(motions), loc="lower center", bbox_to_anchor=(0.5, 1.0))
        below.set(
            yscale="log",
            ylabel="view error, median, mm",
            xlabel="raster and steps of every solution (auto: chosen by the loop)",
        )
        below.yaxis.set_major_formatter("{x:g}")
        below.set_xticks(range(len(efforts)), efforts)
    told = (
        "Live quality and view error with fixed efforts, slowest first, and the loop's choice (stars and dotted lines)."
    )
    return Figure("moving-viewer", png(figure), told)


def focal_section(pinhole: FocalStack, focused: FocalStack) -> PageSection:
    """Return a section with a table of convergence and focal distances, and with focused pictures, for
    layers that were solved without (`pinhole`) and with (`focused`) separate pictures for points of the pupils.
    """
    headings = ["card", "lines of sight meet at, mm", "sharpest in truth, mm"]
    for name in ("without focus", "with focus"):
        headings += [f"sharpest {name}, mm", f"conflict {name}, dioptres"]
    rows = []
    for name, card, own in zip(NAMES, pinhole.cards, focused.cards, strict=True):
        row = [name, f"{1000 * card.card_m:.0f}", f"{1000 * card.sharpest_true_m:.0f}"]
        for sharpest_m in (card.sharpest_shown_m, own.sharpest_shown_m):
            row += [f"{1000 * sharpest_m:.0f}", f"{abs(1 / card.card_m - 1 / sharpest_m):.3f}"]
        rows.append(row)
    text = [
        "Three cards are placed 5 cm behind, in and 4.5 cm in front of the middle panel. They are seen from "
        f"{DISTANCE_M:g} m by a pupil of {1000 * PUPIL_M:g} mm (model {pinhole.model}). On a flat panel, every card is "
        "sharpest in the panel's plane. The pictures on both retinas, focused at each card, are "
        f"{pinhole.retina_db:.1f} dB from those of the cards themselves (retina_db) if the layers were solved for "
        f"pinhole eyes, and {focused.retina_db:.1f} dB if points of each pupil had separate pictures "
        "(content.focus)."
    ]
    caption = (
        "Vergence against accommodation for the right eye. Up to 0.3 dioptres are commonly considered comfortable."
    )
    return PageSection("Focal parallax", text, [slice_picture(pinhole, focused)], [Table(headings, rows, caption)])


def slice_picture(pinhole: FocalStack, focused: FocalStack) -> Figure:
    """Draw pictures focused on each card: through the layers without focus, with it, and in truth."""
    with drawing(9.6, 4.6) as figure:
        axes = figure.subplots(3, 3)
        for column, plane_m in enumerate(CARDS_M):
            plain, own = (min(one.slices, key=lambda s: abs(s.plane_m - plane_m)) for one in (pinhole, focused))
            for row, image in enumerate((plain.shown, own.shown, own.true)):
                axes[row, column].imshow(np.clip(image, 0, 1), interpolation="nearest")
                axes[row, column].set(xticks=[], yticks=[])
                axes[row, column].grid(visible=False)
            axes[0, column].set_title(f"focused {NAMES[column]}", fontsize=10)
        for row, name in enumerate(("without focus", "with focus", "true")):
            axes[row, 0].set_ylabel(name)
    text = "From left to right, the eye is focused on the card behind, in and in front of the middle panel."
    return Figure("focal-slices", png(figure), text)
