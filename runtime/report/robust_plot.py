"""The picture of a robustness run: what each model shows of each pair, against what the reference shows of it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from runtime.report.page import Figure
from runtime.report.plots import COLOURS, drawing, png
from runtime.report.robust import POOR_DB, REACHED_DB, REFERENCE, Outcome, verdict

FAILING = "#c22f2f"


def robust_plot(found: Sequence[Outcome]) -> Figure:
    """A panel a model: a dot a pair, the corner that must be empty shaded, the 5th percentile drawn."""
    models = list(found[0].models)
    reference = np.array([outcome.reference.psnr_db for outcome in found])
    every = [value for o in found for value in (o.reference.psnr_db, *(shown.psnr_db for shown in o.models.values()))]
    low, high = float(np.floor(np.nanmin(every) - 1)), float(np.ceil(np.nanmax(every) + 1))
    with drawing(4.3 * len(models), 4.6) as figure:
        panels = figure.subplots(1, len(models), sharex=True, sharey=True, squeeze=False)[0]
        for axes, name, colour in zip(panels, models, COLOURS, strict=False):
            own = np.array([outcome.models[name].psnr_db for outcome in found])
            failing = np.array([outcome.fails(name) for outcome in found])
            one = verdict(found, name)
            axes.fill_between([REACHED_DB, high], low, POOR_DB, color=FAILING, alpha=0.08, linewidth=0)
            axes.plot([low, high], [low, high], color="#9aa3b5", linewidth=1.0)
            axes.scatter(reference[~failing], own[~failing], s=9, color=colour, alpha=0.55, linewidth=0)
            axes.scatter(reference[failing], own[failing], s=22, marker="x", color=FAILING)
            axes.axhline(one.p5_db, color=colour, linestyle="--", linewidth=1.0)
            lines = [(one.p5_db, f"5th percentile {one.p5_db:.1f} dB", 4)]
            if np.isfinite(one.expected_p5_db):
                axes.axhline(one.expected_p5_db, color=colour, linestyle=":", linewidth=1.0)
                lines.append((one.expected_p5_db, f"of what a pupil (1 mm) sees {one.expected_p5_db:.1f} dB", -11))
            for value, said, up in lines:
                axes.annotate(
                    said,
                    (high, value),
                    xytext=(-4, up),
                    textcoords="offset points",
                    ha="right",
                    fontsize=8.5,
                    color=colour,
                )
            axes.set_title(f"{name}: {one.beats_reference:.0%} above {REFERENCE.name}, {len(one.failing)} fail")
            axes.set(xlabel=f"{REFERENCE.name}, displayed PSNR, dB", xlim=(low, high), ylim=(low, high))
        panels[0].set_ylabel("model, displayed PSNR, dB")
    text = (
        f"Each dot is a random pair. In the shaded corner {REFERENCE.name} reaches {REACHED_DB:g} dB and the model "
        f"stays under {POOR_DB:g}: no dot may lie there. Above the diagonal the model is the better one."
    )
    return Figure("robust", png(figure), text)
