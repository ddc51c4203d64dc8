"""The survey of the plan as table, plots and JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from statistics import median
from typing import Any

from runtime.plan.survey import RegionResult, SceneResult
from runtime.report.plots import COLOURS, INK, drawing, png
from runtime.support.artifacts import write_bytes, write_json, write_text

HEADINGS = ("scene", "on ms", "off ms", "times faster", "on dB", "off dB", "active", "channels")
WITH, WITHOUT = COLOURS[0], "#b8bfcc"


def write_survey(
    folder: Path,
    scenes: Sequence[SceneResult],
    others: Sequence[SceneResult],
    regions: Sequence[RegionResult],
    facts: dict[str, Any],
) -> dict[str, Any]:
    """plan-survey.json, plan-survey.md, plan-scenes.png and plan-regions.png in a folder; answers the JSON."""
    result = facts | {
        "scenes": [asdict(row) for row in scenes],
        "other_sparse": [asdict(row) for row in others],
        "regions": [asdict(row) for row in regions],
    }
    words, bars, lines = (
        table(scenes, others, facts),
        scenes_png([*scenes, *others], facts),
        regions_png(regions, facts),
    )
    write_json(folder / "plan-survey.json", result)
    write_text(folder / "plan-survey.md", words)
    write_bytes(folder / "plan-scenes.png", bars)
    write_bytes(folder / "plan-regions.png", lines)
    return result


def cells(row: Mapping[str, Any]) -> list[str]:
    """One scene of plan-survey.json as words, under HEADINGS."""
    return [
        row["kind"],
        f"{row['ms_with']:.1f}",
        f"{row['ms_without']:.1f}",
        f"{row['faster']:.2f}",
        f"{row['db_with']:.2f}",
        f"{row['db_without']:.2f}",
        f"{row['active_fraction']:.0%}",
        str(row["channels"]),
    ]


def table(scenes: Sequence[SceneResult], others: Sequence[SceneResult], facts: dict[str, Any]) -> str:
    """The scenes as a Markdown table."""
    lines = [
        f"The plan on and off: model {facts['model']}, {facts['width_px']} x {facts['height_px']}, "
        f"{facts['threads']} threads, {facts['date']}. A frame is render and prediction; medians (p99) of "
        f"{scenes[0].frames} frames, on and off in turn.",
        "",
        "| scene | on, ms | off, ms | faster | on, dB | off, dB | lost, dB | active | channels |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for row in (*scenes, *others):
        lost = row.db_without - row.db_with
        lines.append(
            f"| {row.kind} | {row.ms_with:.1f} ({row.ms_with_p99:.1f}) | {row.ms_without:.1f} "
            f"({row.ms_without_p99:.1f}) | {row.faster:.2f} | {row.db_with:.2f} | {row.db_without:.2f} | {lost:+.3f} | "
            f"{row.active_fraction:.0%} | {row.channels} |"
        )
    return "\n".join(lines) + "\n"


def scenes_png(rows: Sequence[SceneResult], facts: dict[str, Any]) -> bytes:
    """Bars of time with and without; beside them how much faster, and what it costs."""
    with drawing(9.0, 0.62 * len(rows) + 1.4) as figure:
        axes = figure.subplots()
        for index, row in enumerate(rows):
            axes.barh(index - 0.2, row.ms_without, 0.36, color=WITHOUT, label="plan off" if not index else None)
            axes.barh(index + 0.2, row.ms_with, 0.36, color=WITH, label="plan on" if not index else None)
            lost = row.db_without - row.db_with
            axes.annotate(
                f"{row.faster:.2f}x, {lost:+.2f} dB lost",
                (max(row.ms_with, row.ms_without), index),
                xytext=(6, 0),
                textcoords="offset points",
                va="center",
                fontsize=8.5,
                color=INK,
            )
        axes.set_yticks(range(len(rows)), [row.kind for row in rows])
        axes.invert_yaxis()
        axes.grid(axis="y", visible=False)
        axes.set_xlim(0, 1.28 * max(max(row.ms_with, row.ms_without) for row in rows))
        axes.set_xlabel("one frame, render and prediction, ms (median)")
        axes.set_title(f"The plan on and off: {facts['model']}, {facts['width_px']} x {facts['height_px']}")
        # Below the plot: bars reach every corner of it.
        figure.legend(loc="outside lower right", ncols=2)
        return png(figure)


def regions_png(rows: Sequence[RegionResult], facts: dict[str, Any]) -> bytes:
    """Time against active pixels, for panels of each size.

    Points are shares of the time without the plan, each measured against frames drawn in turn with it, times the
    median of all frames without: what else the machine did meanwhile stays out of the picture.
    """
    with drawing(8.0, 4.6) as figure:
        axes = figure.subplots()
        sizes = sorted({(row.width_px, row.height_px) for row in rows}, reverse=True)
        for size, colour in zip(sizes, COLOURS, strict=False):
            mine = sorted((row for row in rows if (row.width_px, row.height_px) == size), key=lambda row: row.active_px)
            active = [row.active_px / 1e6 for row in mine]
            label = f"{size[0]} x {size[1]}"
            whole_ms = median(row.ms_without for row in mine)
            axes.plot(active, [row.share * whole_ms for row in mine], "o-", color=colour, label=f"plan on, {label}")
            axes.axhline(whole_ms, linestyle="--", color=colour, alpha=0.5, label=f"plan off, {label}")
        axes.set_xlim(left=0)
        axes.set_ylim(bottom=0)
        axes.set_xlabel("active pixels of a panel, millions")
        axes.set_ylabel("one frame, ms")
        axes.set_title(f"Cost grows with active pixels: {facts['model']}, a card that grows")
        axes.legend()
        return png(figure)
