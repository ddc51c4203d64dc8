"""Run the report's measurements in order, and rewrite the page and the record after every result."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

from runtime.config import ModelSettings, StackGeometry
from runtime.model.predictor import load_predictor
from runtime.records import Effort
from runtime.report import focal, moving
from runtime.report.benchmark import too_busy, yardstick_ms
from runtime.report.frontier import Method, MethodResult, apart, measure, shipped_and_references
from runtime.report.page import Page, PageSection, describe
from runtime.report.pairs import StillPair, procedural_pairs, read_pairs
from runtime.report.sections import focal_section, frontier_section, moving_section

QUOTE = "light_db at a tracking error of 1 mm, the mean over both eyes' pupils and pixels; for motion, live_db"
Progress = Callable[[str], None]


class GrowingPage:
    """A report that rewrites index.html, report.json and the plots after every new result.

    A report that is stopped early is still usable, because its files contain all results obtained so far.
    """

    def __init__(self, out: Path, command: str, progress: Progress) -> None:
        self.out, self._command, self._progress = out, command, progress
        self._sections: dict[str, PageSection] = {}
        self.record: dict[str, Any] = {"machine": describe(), "command": command, "quote": QUOTE, "complete": False}
        self.record["yardsticks_ms"] = [yardstick_ms()]

    def doing(self, what: str) -> None:
        """Announce a measurement that is about to start, and enter it in the record as the last known step."""
        self._progress(what)
        self.record["measuring"] = what

    def put(self, name: str, section: PageSection) -> None:
        """Add a section under a name, or replace the existing section of that name, and write the files."""
        self._sections[name] = section
        self.write()

    def finished(self) -> None:
        """Mark the report as complete and write the files."""
        del self.record["measuring"]
        self.record["complete"] = True
        self.write()

    def write(self) -> None:
        """Write all results measured so far. Raises InputError if the files cannot be written."""
        doing = self.record.get("measuring")
        notes = (
            [f"This report is not finished; results are added as they come in. Last known step: {doing}."]
            if doing
            else []
        )
        if busy := too_busy(self.record["yardsticks_ms"]):
            notes.append(f"Do not compare these times or their ratios, because the machine was busy: {busy}.")
        sections, machine = list(self._sections.values()), self.record["machine"]
        lead = "The figure to quote is the light at a tracking error of 1 mm (higher is better)."
        page = Page("Light against run time", lead, sections, machine, self._command, notes)
        page.write(self.out, data=self.record)


def whole_report(
    out: Path,
    *,
    pairs: Path | None = None,
    with_focal: bool = False,
    models: Sequence[str] = (),
    quick: bool = False,
    command: str = "phasestack report",
    progress: Progress = lambda name: None,
) -> dict[str, Any]:
    """Run all measurements, write the results to a folder and return the contents of report.json.

    Case files and models are checked before the first measurement.

    Args:
        out: Folder for the page, the plots and report.json.
        pairs: Folder with case files. They are measured before the built-in scenes.
        with_focal: Also measure focal parallax.
        models: Names or ONNX files of models to measure in addition to the shipped ones.
        quick: Draw built-in scenes with a quarter of the pixels, omit the slowest reference, and use shorter motions.
        command: Command that reproduces the report, shown on the page.
        progress: Function called with the name of each step.

    Raises:
        InputError: A case file or a model is invalid, or the results cannot be written.
        FatalError: A measuring process failed.
    """
    cases = read_pairs(pairs) if pairs is not None else []
    stack = StackGeometry().stack()
    if quick:
        stack = replace(stack, width_px=960, height_px=540)
    for name in models:
        # Reject an invalid model now rather than after minutes of measuring.
        for each in dict.fromkeys([*(pair.stack for pair in cases), stack]):
            load_predictor(name, each, ModelSettings(threads=1)).close()
    page = GrowingPage(out, command, progress)
    methods = shipped_and_references(models, quick=quick)
    for size, own in _by_size(cases).items():
        title = f"{len(own)} case file{'s' if len(own) > 1 else ''}, {size}"
        _frontier(page, methods, own, title=title, name=f"cases-{size}", key="methods")
    key = "methods_on_built_in_scenes" if cases else "methods"
    _frontier(page, methods, procedural_pairs(stack), title="built-in scenes", name="scenes", key=key)
    _moving(page, quick=quick)
    if with_focal:
        _focal(page)
    page.finished()
    return page.record


def _by_size(cases: Sequence[StillPair]) -> dict[str, list[StillPair]]:
    groups: dict[str, list[StillPair]] = {}
    for pair in cases:
        groups.setdefault(f"{pair.stack.width_px}x{pair.stack.height_px}", []).append(pair)
    return groups


def _frontier(
    page: GrowingPage, methods: Sequence[Method], pairs: Iterable[StillPair], *, title: str, name: str, key: str
) -> None:
    """Measure pairs of one resolution, and update the section called `name` and the record's `key` list."""
    title = f"Light against run time: {title}"
    page.doing(f"{title}: drawing")
    before, results = page.record.get(key, []), dict[str, MethodResult]()
    for done, result in measure(methods, pairs, viewers=page.out):
        page.doing(f"{title}: finished {done}")
        page.record["yardsticks_ms"].append(yardstick_ms())
        results[result.name] = result
        page.record[key] = before + [asdict(one) for one in results.values()]
        page.put(name, frontier_section(list(results.values()), title=title, name=name))


def _moving(page: GrowingPage, *, quick: bool) -> None:
    """Measure all motions in parallel. The clock is simulated, so the results are not affected by load."""
    fixed = (moving.FULL, Effort(2, 0)) if quick else moving.FIXED
    runs = [(motion, effort) for motion in moving.SCENES for effort in (None, *fixed)]
    small = partial(moving.moving_run, scale=0.15, seconds=2.5)
    measure: Callable[..., moving.Moving] = small if quick else moving.moving_run
    results: list[moving.Moving] = []
    page.doing("what a moving viewer sees")
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        done = pool.map(lambda run: apart(measure, *run), runs)
        for result in done:
            page.doing(f"what a moving viewer sees: finished {result.motion} with effort {result.effort}")
            results.append(result)
            page.record["moving"] = [asdict(one) for one in results]
            page.put("moving", moving_section(results))


def _focal(page: GrowingPage) -> None:
    full = StackGeometry().stack()
    with focal.cards_painter(full) as painter:
        stack = focal.focal_stack(
            painter, full, model="best", progress=lambda done, of: page.doing(f"focal stack {done}/{of}")
        )
    page.record["focal"] = {"model": stack.model, "cards": [asdict(card) for card in stack.cards]}
    page.put("focal", focal_section(stack))
