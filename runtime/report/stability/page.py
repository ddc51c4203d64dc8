"""The stability page: what was tried, and how it ended."""

from __future__ import annotations

import math
from collections.abc import Sequence

from runtime.report.page import Figure, Page, Section, Table
from runtime.report.plots import drawing, png
from runtime.report.stability.trial import Case


def stages_of(cases: Sequence[Case]) -> list[str]:
    """Each stage once, in the order of its first case."""
    return list(dict.fromkeys(case.stage for case in cases))


def stiffness_plot(cases: Sequence[Case]) -> Figure:
    """What each method leaves of the stiffest wave, over the condition of the two-eye operator."""
    own = [c for c in cases if c.stage == "solve" and c.measure == "of the wanted" and math.isfinite(c.forward_error)]
    with drawing(9.6, 4.2) as figure:
        axes = figure.add_subplot()
        for name in dict.fromkeys(case.name.partition(",")[0] for case in own):
            points = sorted((c.condition, c.forward_error) for c in own if c.name.partition(",")[0] == name)
            axes.plot(*zip(*points, strict=True), marker="o", markersize=4, label=name)
        bounds = sorted({(c.condition, c.forward_error - c.backward_error) for c in own})
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
        f"All {len(cases)} stiff and extreme cases behave as stated, in {seconds:.0f} s; {refused} are refused."
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
        [stiffness_plot(cases)] if "solve" in stages else [],
        [] if not failed else [Table(headings, [row(c) for c in failed], "What fails", ["bad"] * len(failed))],
    )
    sections = [summary]
    for stage in stages:
        own = [case for case in cases if case.stage == stage]
        styles = ["" if case.passed else "bad" for case in own]
        table = Table(headings, [row(case) for case in own], styles=styles, folded=True)
        sections.append(Section(stage[0].upper() + stage[1:], tables=[table]))
    return Page("Numerical stability", lead, sections, machine, command)
