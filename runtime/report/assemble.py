"""The whole report: what is measured, in which order, and the page and record that grow with it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from time import monotonic
from typing import Any

from runtime.config import StackGeometry
from runtime.report import focal, moving
from runtime.report.focal_page import focal_section
from runtime.report.frontier import MethodResult, check_models, measure
from runtime.report.frontier_page import frontier_section
from runtime.report.machine import describe
from runtime.report.methods import Method, shipped_and_references
from runtime.report.moving_page import moving_section
from runtime.report.page import Page, Section, Tile
from runtime.report.pairs import StillPair, procedural_pairs, read_pairs
from runtime.report.worker import apart

REWRITTEN_EVERY_S = 10.0
QUOTE = "light_db of eyes sure to 1 mm: what both eyes make of the panels' pixels"
Progress = Callable[[str], None]
Published = Callable[[int, int], list[Method]]  # the published network for panels so wide and high


class GrowingPage:
    """index.html, report.json and the plots: written anew as there is more, so that a stopped report is a page too."""

    def __init__(self, out: Path, command: str, progress: Progress) -> None:
        self._out, self._command, self._progress = out, command, progress
        self._sections: dict[str, Section] = {}
        self._written_s = float("-inf")
        self.results: list[MethodResult] = []  # that the page's head tells of
        self.record: dict[str, Any] = {"machine": describe(seed=0), "command": command, "quote": QUOTE}

    def doing(self, what: str) -> None:
        """What is measured now."""
        self._progress(what)
        self.record["measuring"] = what

    def put(self, name: str, make: Callable[[], Section], *, last: bool = False) -> None:
        """A section as it is now; drawn and written unless it was just before. last: it will not change any more."""
        if last or monotonic() - self._written_s > REWRITTEN_EVERY_S:
            self._sections[name] = make()
            self.write()

    def finished(self) -> None:
        """Nothing more will come."""
        del self.record["measuring"]
        self.write()

    def write(self) -> None:
        """All there is. Raises InputError."""
        doing = self.record.get("measuring")
        notes = [f"Not finished: it grows while it is measured. The last that was known: {doing}."] if doing else []
        sections, machine = list(self._sections.values()), self.record["machine"]
        lead = "Light, of eyes sure to 1 mm, is the figure to quote; higher is better."
        page = Page("Error against run time", lead, sections, machine, self._command, _tiles(self.results), notes)
        page.write(self._out, record="report.json", data=self.record | {"complete": doing is None})
        self._written_s = monotonic()


def whole_report(
    out: Path,
    *,
    pairs: Path | None = None,
    with_focal: bool = False,
    models: Sequence[str] = (),
    quick: bool = False,
    command: str = "phasestack report",
    published: Published = lambda width_px, height_px: [],
    progress: Progress = lambda name: None,
) -> dict[str, Any]:
    """Measure everything into a folder; answers report.json's object. `quick`: quarter-size panels, fewer references.

    Raises InputError for case files and models with mistakes, before anything is measured.
    """
    cases = read_pairs(pairs) if pairs is not None else []
    check_models(models)
    stack = StackGeometry().stack()
    if quick:
        stack = replace(stack, width_px=960, height_px=540)
    page = GrowingPage(out, command, progress)
    methods = shipped_and_references(models, quick=quick)
    frontier: list[MethodResult] = []
    for size, own in _by_size(cases).items():
        title = f"Error against run time: {len(own)} case file{'s' if len(own) > 1 else ''}, {size}"
        frontier += _frontier(page, methods, own, title=title, name=f"cases-{size}", before=frontier, key="methods")
    key = "methods_on_built_in_scenes" if frontier else "methods"
    title = "Error against run time: built-in scenes"
    scenes = _frontier(page, methods, procedural_pairs(stack), title=title, name="scenes", before=[], key=key)
    page.doing("the published network")
    if found := published(stack.width_px, stack.height_px):
        first = next(iter(procedural_pairs(stack)))
        for _, results in measure(found, [first]):
            everything = [*scenes, *results]
        page.record[key] = [result.record() for result in everything]
        page.results = everything
        page.put(
            "scenes", lambda: frontier_section(everything, pairs=_names(scenes), title=title, name="scenes"), last=True
        )
    _moving(page, quick=quick)
    if with_focal:
        _focal(page)
    page.finished()
    return page.record | {"complete": True}


def _frontier(
    page: GrowingPage,
    methods: Sequence[Method],
    pairs: Iterable[StillPair],
    *,
    title: str,
    name: str,
    before: Sequence[MethodResult],
    key: str,
) -> list[MethodResult]:
    page.doing(f"{title}: drawing")
    results: list[MethodResult] = []
    for done, results in measure(methods, pairs):
        page.doing(f"{title}: {done} is done")
        page.record[key] = [result.record() for result in (*before, *results)]
        if key == "methods":
            page.results = results
        page.put(name, lambda: frontier_section(results, pairs=_names(results), title=title, name=name))  # noqa: B023
    page.put(name, lambda: frontier_section(results, pairs=_names(results), title=title, name=name), last=True)
    return results


def _names(results: Sequence[MethodResult]) -> str:
    return "; ".join(pair.pair for pair in results[0].pairs)


def _by_size(cases: Sequence[StillPair]) -> dict[str, list[StillPair]]:
    groups: dict[str, list[StillPair]] = {}
    for pair in cases:
        groups.setdefault(f"{pair.stack.width_px}x{pair.stack.height_px}", []).append(pair)
    return groups


def _moving(page: GrowingPage, *, quick: bool) -> None:
    found: list[moving.Moving] = []
    for motion in moving.MOTIONS:
        for solver_ms in moving.SOLVER_MS:
            page.doing(f"what a moving viewer sees: {motion}, {solver_ms:g} ms")
            found.append(apart(moving.moving_run, motion, solver_ms, scale=0.25 if quick else 0.5))
            page.record["moving"] = [asdict(one) for one in found]
            page.put("moving", lambda: moving_section(found))
    page.put("moving", lambda: moving_section(found), last=True)


def _focal(page: GrowingPage) -> None:
    full = StackGeometry().stack()
    with focal.cards_painter(full) as painter:
        stack = focal.focal_stack(
            painter, full, model="best", progress=lambda done, of: page.doing(f"focal stack {done}/{of}")
        )
    page.record["focal"] = {
        "model": stack.model,
        "pinhole_db": stack.pinhole_db,
        "slices": [
            {"plane_m": s.plane_m, "psnr_db": s.psnr_db, "contrast": s.contrast_shown, "contrast_true": s.contrast_true}
            for s in stack.slices
        ],
        "cards": [asdict(card) for card in stack.cards],
    }
    page.put("focal", lambda: focal_section(stack), last=True)


def _tiles(results: Sequence[MethodResult]) -> list[Tile]:
    by_name = {result.name: result for result in results}
    tiles = [Tile(f"{r.quoted_db:.1f} dB", f"light, {r.name}") for r in results if r.kind == "network" and r.trained]
    if {"eyereal", "balanced"} <= by_name.keys():
        ratio = by_name["eyereal"].ms_p50 / by_name["balanced"].ms_p50
        tiles.append(Tile(f"1/{ratio:.0f}", "of the published network's time, balanced"))
    return tiles
