"""The stability page: what was tried, how it ended, and how many digits there were to spare."""

from __future__ import annotations

import math
from collections.abc import Sequence

from runtime.report.page import Figure, Page, Section, Table, Tile
from runtime.report.plots import COLOURS, drawing, png
from runtime.report.stability.solve import GEOMETRIES, problem_of
from runtime.report.stability.trial import EPS64, Case

COLUMNS = 30
NO_ROUNDING = {"solve", "network"}  # stages whose errors are no matter of rounding
ABOUT = {
    "eye pose": "Where an eye is and how its head is turned: on and near the vertical axis, in, between and behind "
    "the panels, from 1e-200 to 1e200 m (EyeReal supplement, (10)-(14)).",
    "RPU": "The mapping from an eye's image to a panel, against rays traced with 50 digits: up to 89.99 degrees, "
    "down to 1e-11 m from a panel's plane, panels from a micrometre to a thousand kilometres (equations (40)-(47)).",
    "phase": "From intensity to phase and back. The arcsine's slope is infinite at white, so the phase there loses "
    "half its digits; the intensity, which is what is seen, loses none (EyeReal supplement, (1)-(7)).",
    "Jones optics": "sin² of the summed phase against the product of the panels' Jones matrices.",
    "retina": "What eyes see, and PSNR, against a tracer of 50 digits: every ray of small pictures.",
    "solve": "The stiff part of the two-eye problem is the lowest frequency of the difference between the eyes. "
    "Its condition grows as 1/gap², and values between 0 and 1 can show only so much of it: the note says what no "
    "panel values can do better, by exact least squares. A method may be no worse than recorded by more than 5%.",
    "tracker": "The filter against a Kalman filter of 50 digits; an evenly moving head at time steps from 0 to a day, "
    "gains from stiff to lax, and single samples of nonsense.",
    "calibration": "The similarity from pairs that hardly determine it, and from noisy ones by every rule, against "
    "closed forms of 50 digits. Where rounding alone could turn the result by more than a microradian it must refuse.",
    "network": "The shipped networks on pictures and poses that they were not trained for: no worse than recorded by "
    "more than 5%.",
}


def spare_digits(case: Case) -> float:
    """Decimal digits between the error and its tolerance; negative where it fails."""
    if not math.isfinite(case.forward_error):
        return math.nan
    if case.forward_error == 0.0:
        return math.inf
    return math.log10(max(case.tolerance, 1e-18) / max(case.forward_error, 1e-18))


def stages_of(cases: Sequence[Case]) -> list[str]:
    """Each stage once, in the order of its first case."""
    return list(dict.fromkeys(case.stage for case in cases))


def heat_map(cases: Sequence[Case]) -> Figure:
    """A square a case, row by row within its stage."""
    rows: list[tuple[str, list[Case]]] = []
    for stage in stages_of(cases):
        own = [case for case in cases if case.stage == stage]
        rows += [(stage if not start else "", own[start : start + COLUMNS]) for start in range(0, len(own), COLUMNS)]
    with drawing(9.6, 0.9 + 0.29 * len(rows)) as figure:
        from matplotlib.colors import BoundaryNorm, ListedColormap
        from matplotlib.patches import Patch, Rectangle

        axes = figure.add_subplot()
        colours = ["#f0c24b", "#a9cfb0", "#5aa98a", "#1c6f7d", "#123f63"]
        limits = [0, 0.5, 1, 2, 4, 20]
        map_, norm = ListedColormap(colours), BoundaryNorm(limits, len(colours))
        for y, (_, own) in enumerate(rows):
            for x, case in enumerate(own):
                spare = spare_digits(case)
                face = "#d7dce6" if math.isnan(spare) else map_(norm(min(max(spare, 0), 19)))
                if not case.passed:
                    face = "#c0322b"
                axes.add_patch(Rectangle((x, y), 0.9, 0.86, facecolor=face, linewidth=0))
                if case.behaviour == "warns":
                    axes.text(x + 0.45, y + 0.45, "!", ha="center", va="center", color="white", fontsize=8)
                if not case.passed:
                    axes.text(x + 0.45, y + 0.45, "×", ha="center", va="center", color="white", fontsize=9)
        axes.set(xlim=(0, COLUMNS), ylim=(len(rows), 0), xticks=[])
        axes.set_yticks([y + 0.45 for y in range(len(rows))], [name for name, _ in rows])
        axes.grid(visible=False)
        axes.tick_params(length=0)
        for side in ("left", "bottom"):
            axes.spines[side].set_visible(False)
        named = ["under half a digit to spare", "half to 1", "1 to 2", "2 to 4", "over 4 digits to spare"]
        handles = [Patch(color=colour, label=name) for colour, name in zip(colours, named, strict=True)]
        handles += [Patch(color="#d7dce6", label="refuses, as it must"), Patch(color="#c0322b", label="× fails")]
        figure.legend(handles=handles, loc="outside lower left", ncols=4, fontsize=8.5)
    text = "Every case a square: how far its error stays below its tolerance. ! answers with a warning."
    return Figure("heat-map", png(figure), text)


def condition_plot(cases: Sequence[Case]) -> Figure:
    """Error against condition: a stable method stays along eps times the condition."""
    with drawing(9.6, 4.6) as figure:
        axes = figure.add_subplot()
        span = [1.0, 1e13]
        axes.plot(span, [EPS64 * c for c in span], color="#9aa3b5", linestyle="--", linewidth=1.2)
        axes.text(1.5e9, 6e-8, "rounding of the input × condition", color="#5b6478", rotation=24, ha="center")
        left_out = NO_ROUNDING
        for colour, stage in zip(COLOURS, [s for s in stages_of(cases) if s not in left_out], strict=False):
            own = [c for c in cases if c.stage == stage and math.isfinite(c.forward_error) and c.condition < 1e14]
            points = [(c.condition, max(c.forward_error, 1e-18)) for c in own]
            if points:
                axes.scatter(*zip(*points, strict=True), s=20, color=colour, alpha=0.75, label=stage, linewidth=0)
        axes.set(xscale="log", yscale="log", xlim=(0.7, 3e13), ylim=(5e-19, 1))
        axes.set(
            xlabel="condition of the problem",
            ylabel="forward error",
            title="Errors grow as the problems do, not faster",
        )
        axes.legend(ncols=4, loc="upper left", fontsize=8.5)
    text = (
        "A dot a case. Along the dashed line a method loses only what the rounding of its input must cost. Dots above "
        "it at condition 1 are single precision and panels of 8 to 16 bits, whose tolerances are their own grey steps."
    )
    return Figure("error-against-condition", png(figure), text)


def stiffness_plot(cases: Sequence[Case]) -> Figure:
    """What each method leaves of the stiffest wave, over the condition of the two-eye operator."""
    own = [c for c in cases if c.stage == "solve" and c.measure == "of the wanted" and math.isfinite(c.forward_error)]
    with drawing(9.6, 4.2) as figure:
        axes = figure.add_subplot()
        for name in dict.fromkeys(case.name.partition(",")[0] for case in own):
            points = sorted((c.condition, c.forward_error) for c in own if c.name.partition(",")[0] == name)
            axes.plot(*zip(*points, strict=True), marker="o", markersize=4, label=name)
        bounds = sorted((problem.condition(), problem.optimum()) for problem in map(problem_of, GEOMETRIES))
        axes.plot(*zip(*bounds, strict=True), color="#9aa3b5", linestyle="--", linewidth=1.2, label="does not fit")
        axes.set(xscale="log", ylim=(0, 0.7), ylabel="part of the wanted left")
        axes.set(xlabel="condition of the two-eye operator for one cycle across the panels")
        axes.set(title="Small gaps, close-set eyes and far viewers: no method gets there")
        axes.legend(ncols=4, loc="upper left", fontsize=8.5)
    text = (
        "Each method on the same small problem with gaps from 0.1 mm to 1 m, eyes 0.1 to 200 mm apart, 0.1 to 30 m "
        "away. Dashed: what doesn't fit between black and white, so that no method can show it (exact least squares "
        "within the box). SART serves the eyes in turn: what it misses is all taken from the first."
    )
    return Figure("stiffness", png(figure), text)


def row(case: Case) -> list[str]:
    """A case as the cells of a table."""

    def shown(value: float) -> str:
        return "" if math.isnan(value) else "∞" if math.isinf(value) else f"{value:.1e}"

    refused = case.behaviour == "refuses"
    return [
        case.name,
        case.behaviour if case.passed else f"{case.behaviour}: FAILS",
        shown(case.condition),
        shown(case.forward_error),
        shown(case.backward_error),
        "" if refused else shown(case.tolerance),
        "" if refused else case.measure,
        case.note,
    ]


def stability_page(cases: Sequence[Case], *, machine: dict[str, str], seconds: float, command: str) -> Page:
    """The whole page."""
    failed = [case for case in cases if not case.passed]
    refused = sum(case.behaviour == "refuses" for case in cases)
    stages = stages_of(cases)
    lead = (
        f"All {len(cases)} stiff and extreme cases behave as stated."
        if not failed
        else f"{len(failed)} of {len(cases)} stiff and extreme cases fail: {', '.join(c.name for c in failed[:5])}."
    )
    headings = ["case", "behaviour", "condition", "forward error", "backward error", "tolerance", "measured", "note"]
    summary = Section(
        "At a glance",
        [
            "Each numerical step runs on cases that are meant to break it and is compared with a reference of 50 "
            "digits or a closed form. The tolerance is stated before the case runs: a small multiple of the rounding "
            "of the input times the condition of the problem, or what was recorded of the case and 5%.",
        ],
        [
            heat_map(cases),
            *([condition_plot(cases)] if set(stages) - NO_ROUNDING else []),
            *([stiffness_plot(cases)] if "solve" in stages else []),
        ],
        [] if not failed else [Table(headings, [row(c) for c in failed], "What fails", ["bad"] * len(failed))],
    )
    sections = [summary]
    for stage in stages:
        own = [case for case in cases if case.stage == stage]
        styles = ["" if case.passed else "bad" for case in own]
        table = Table(headings, [row(case) for case in own], styles=styles, folded=True)
        sections.append(Section(stage[0].upper() + stage[1:], [ABOUT.get(stage, "")], tables=[table]))
    tiles = [
        Tile(str(len(cases)), "cases"),
        Tile(str(len(stages)), "stages"),
        Tile(str(len(failed)), "fail", "bad" if failed else "good"),
        Tile(str(refused), "refused, in one line"),
        Tile(f"{seconds:.0f} s", "for all of them"),
    ]
    return Page("Numerical stability", lead, sections, machine, command, tiles)
