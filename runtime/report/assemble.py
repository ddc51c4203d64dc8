"""The whole report, which runs the measurements in order and rewrites page and record after each."""

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
    """index.html, report.json and plots, rewritten with every result so that a stopped report is usable."""

    def __init__(self, out: Path, command: str, progress: Progress) -> None:
        self.out, self._command, self._progress = out, command, progress
        self._sections: dict[str, PageSection] = {}
        self.record: dict[str, Any] = {"machine": describe(), "command": command, "quote": QUOTE, "complete": False}
        self.record["yardsticks_ms"] = [yardstick_ms()]

    def doing(self, what: str) -> None:
        """Record which measurement is in progress."""
        self._progress(what)
        self.record["measuring"] = what

    def put(self, name: str, section: PageSection) -> None:
        """Add a section or replace the one of the same name."""
        self._sections[name] = section
        self.write()

    def finished(self) -> None:
        """Mark the report as complete."""
        del self.record["measuring"]
        self.record["complete"] = True
        self.write()

    def write(self) -> None:
        """Write everything measured so far. Raises InputError if the files cannot be written."""
        doing = self.record.get("measuring")
        notes = (
            [f"This report is not finished and grows as results come in. The last known step is: {doing}."]
            if doing
            else []
        )
        if busy := too_busy(self.record["yardsticks_ms"]):
            notes.append(f"Do not compare these times or their ratios, because the machine was busy: {busy}.")
        sections, machine = list(self._sections.values()), self.record["machine"]
        lead = "Quote the light at a tracking error of 1 mm. Higher is better."
        page = Page("Light against run time", lead, sections, machine, self._command, notes)
        page.write(self.out, record="report.json", data=self.record)


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
    """Run all measurements, write them to a folder and return the contents of report.json.

    quick: at a quarter of the size, with fewer references. Raises InputError for invalid case files and models, before
    measuring.
    """
    cases = read_pairs(pairs) if pairs is not None else []
    stack = StackGeometry().stack()
    if quick:
        stack = replace(stack, width_px=960, height_px=540)
    for name in models:
        for each in dict.fromkeys([*(pair.stack for pair in cases), stack]):  # refuse it now instead of minutes later
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
    """Measure pairs of one resolution. key: list in the record to which the methods are added."""
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
    """Measure all motions. Runs on a simulated clock may run in parallel."""
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
