"""Run the report's measurements in order, and rewrite the page and the record after every result."""

from __future__ import annotations

import itertools
import os
import sys
from collections.abc import Callable, Iterable, Sequence, Sized
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from runtime.config import StackGeometry
from runtime.errors import FatalError, InputError, MissingPart
from runtime.model.predictor import SHIPPED
from runtime.optics.stack import PanelStack
from runtime.records import Effort
from runtime.report import focal, moving
from runtime.report.benchmark import too_busy, yardstick_ms
from runtime.report.frontier import Method, MethodResult, apart, given_layers, measure, shipped_and_references
from runtime.report.page import Page, PageSection, describe
from runtime.report.pairs import PROCEDURAL, StillPair, procedural_pairs, read_pairs
from runtime.report.sections import focal_section, frontier_section, moving_section

QUOTE = "light_db at a tracking error of 1 mm, the mean over both eyes' pupils and pixels; for motion, live_db"
Progress = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Own:
    """Options for the measurements and the case files."""

    processes: int = 1  # number of methods on pairs that are measured at the same time
    only: bool = False  # True to measure only the case files, and no built-in scenes or motions
    layers: tuple[Path, ...] = ()  # folders with other solvers' layers for the case files (docs/contracts.md)


OWN = Own()


class GrowingPage:
    """A report that rewrites its files after every result, so that it can be stopped early."""

    def __init__(self, out: Path, command: str, progress: Progress) -> None:
        self.out, self._command, self._progress = out, command, progress
        self._sections: dict[str, PageSection] = {}
        self.record: dict[str, Any] = {"machine": describe(), "command": command, "quote": QUOTE, "complete": False}
        self.record["yardsticks_ms"] = [yardstick_ms()]

    def doing(self, what: str) -> None:
        """Announce a measurement that is about to start, and enter it in the record as the last known step."""
        self._progress(what)
        self.record["measuring"] = what

    def failed(self, what: str, error: FatalError) -> None:
        """Print a failed measurement as a line, and enter it in the record."""
        self.record["failed"] = [*self.record.get("failed", []), f"{what}: {error}"]
        print(f"report: {what}: {error}", file=sys.stderr, flush=True)

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
        """Write all results. Raises InputError if the files cannot be written."""
        doing = self.record.get("measuring")
        notes = (
            [f"This report is not finished; results are added as they come in. Last known step: {doing}."]
            if doing
            else []
        )
        notes += [
            f"This measurement failed and is missing from the means: {one}." for one in self.record.get("failed", [])
        ]
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
    own: Own = OWN,
    with_focal: bool = False,
    models: Sequence[str] = (),
    quick: bool = False,
    command: str = "phasestack report",
    progress: Progress = lambda name: None,
) -> dict[str, Any]:
    """Run all measurements, write page, plots and report.json to a folder, and return the contents of the
    latter.

    Case files in `pairs`, and models, are checked before the first measurement; `own` says what else is done with them,
    and `models` are measured in addition to the shipped ones. `quick` draws built-in scenes with a quarter of the
    pixels, omits the slowest reference and shortens motions. Raises InputError for a case file or a model, or if
    results cannot be written. The record's `failed` lists measurements that failed.
    """
    cases = read_pairs(pairs) if pairs is not None else []
    stack = StackGeometry().stack()
    if quick:
        stack = replace(stack, width_px=960, height_px=540)
    methods = shipped_and_references(models, quick=quick)
    _refuse_unsuitable(methods, cases, () if own.only else (stack,))
    others = [given_layers(folder, cases) for folder in own.layers]
    page = GrowingPage(out, command, progress)
    for number, (each, group) in enumerate(_by_stack(cases).items()):
        title = f"{len(group)} case file{'s' if len(group) > 1 else ''}, {_described(each)}"
        _frontier(page, [*others, *methods], group, title=title, name=f"cases-{number + 1}", processes=own.processes)
    if not own.only:
        key = "methods_on_built_in_scenes" if cases else "methods"
        scenes = procedural_pairs(stack)
        _frontier(page, methods, scenes, title="built-in scenes", name="scenes", key=key, processes=own.processes)
        _moving(page, quick=quick)
    if with_focal:
        _focal(page)
    page.finished()
    return page.record


def _refuse_unsuitable(methods: Sequence[Method], cases: Sequence[StillPair], stacks: Sequence[PanelStack]) -> None:
    """Load every method for every stack now, or raise InputError, which names the first case file."""
    for stack in dict.fromkeys([*(pair.stack for pair in cases), *stacks]):
        for method in methods:
            try:
                method.opened(stack, threads=1).close()
            except (InputError, MissingPart) as error:
                named = next((pair.name for pair in cases if pair.stack == stack), None)
                if named is None or method.source not in SHIPPED:
                    raise
                raise InputError(f"{named}.json", "panels", str(error)) from None


def _by_stack(cases: Sequence[StillPair]) -> dict[PanelStack, list[StillPair]]:
    groups: dict[PanelStack, list[StillPair]] = {}
    for pair in cases:
        groups.setdefault(pair.stack, []).append(pair)
    return groups


def _described(stack: PanelStack) -> str:
    """Return a stack's number of panels, gaps and raster, such as `3 panels 60 mm apart, 1920x1080`."""
    gaps = {f"{1000 * (b - a):.3g}" for a, b in itertools.pairwise(stack.x_m)}
    apart_mm = f"{gaps.pop()} mm apart" if len(gaps) == 1 else f"{1000 * (stack.x_m[-1] - stack.x_m[0]):.3g} mm deep"
    return f"{stack.count} panels {apart_mm}, {stack.width_px}x{stack.height_px}"


def _frontier(
    page: GrowingPage,
    methods: Sequence[Method],
    pairs: Iterable[StillPair],
    *,
    title: str,
    name: str,
    key: str = "methods",
    processes: int = 1,
) -> None:
    """Measure pairs of one resolution, and update the section called `name` and the record's `key` list."""
    title = f"Light against run time: {title}"
    page.doing(f"{title}: drawing")
    before, results = page.record.get(key, []), dict[str, MethodResult]()
    total = len(methods) * (len(pairs) if isinstance(pairs, Sized) else len(PROCEDURAL))
    for number, (done, result) in enumerate(measure(methods, pairs, viewers=page.out, processes=processes), start=1):
        page.doing(f"{title}: finished {number} of {total}, {done}")
        page.record["yardsticks_ms"].append(yardstick_ms())
        if not isinstance(result, MethodResult):
            page.failed(done, result)
            continue
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
            results.append(result)
            count = f"{len(results)} of {len(runs)}"
            page.doing(f"what a moving viewer sees: finished {count}, {result.motion} with effort {result.effort}")
            page.record["moving"] = [asdict(one) for one in results]
            page.put("moving", moving_section(results))


def _focal(page: GrowingPage) -> None:
    full = StackGeometry().stack()

    def told(part: int, done: int, of: int) -> None:
        page.doing(f"focal stack {part} of 2, {done}/{of}")

    with focal.cards_painter(full) as painter:
        pinhole, focused = (
            focal.focal_stack(painter, full, model="best", focus=focus, progress=partial(told, part))
            for part, focus in ((1, False), (2, True))
        )
    page.record["focal"] = {"model": pinhole.model, **_found(pinhole), "focus": _found(focused)}
    page.put("focal", focal_section(pinhole, focused))


def _found(stack: focal.FocalStack) -> dict[str, Any]:
    """Return a focal stack's entries in report.json."""
    return {"cards": [asdict(card) for card in stack.cards], "retina_db": stack.retina_db}
