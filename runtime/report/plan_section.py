"""What the plan leaves out, in the report: the same survey as `phasestack plan --survey`."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from runtime.report.page import Figure, Section, Table
from runtime.report.survey_page import HEADINGS, cells
from runtime.report.survey_run import survey
from runtime.report.worker import apart

CAPTIONS = {
    "plan-scenes": "Blue: with the plan. Grey: without. Beside the bars: how much faster, and what it costs.",
    "plan-regions": "A card that grows, on panels of two sizes. Dashed: without the plan.",
}


def surveyed(*, quick: bool) -> tuple[Section, dict[str, Any]]:
    """Measure it in a process of its own. The section, and what report.json has of it. Raises FatalError."""
    with tempfile.TemporaryDirectory(prefix="phasestack-") as folder:
        out = Path(folder) / "plan"
        record = apart(survey, None, out=out, model=None, scale=1.0, quick=quick, quiet=True)
        pictures = {name: (out / f"{name}.png").read_bytes() for name in CAPTIONS}
    return plan_section(record, pictures), record


def plan_section(record: dict[str, Any], pictures: dict[str, bytes]) -> Section:
    """The survey's record and its two plots as a section."""
    rows = [
        [*cells(row), "; ".join(str(item["what"]) for item in row["left_out"])]
        for row in (*record["scenes"], *record["other_sparse"])
    ]
    text = [
        f"Six kinds of scenes and other small objects with the plan and without, model {record['model']} at "
        f"{record['width_px']}x{record['height_px']}: frames with and without in turn, rendering and prediction. "
        "By command: phasestack plan --survey.",
    ]
    figures = [Figure(name, pictures[name], caption) for name, caption in CAPTIONS.items()]
    return Section("What a scene does not need", text, figures, [Table([*HEADINGS, "left out"], rows)])
