"""Run of `phasestack tolerance`, which writes its page and tolerance.json as results come in."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np

from runtime.config import ModelSettings, load_settings
from runtime.errors import InputError
from runtime.model.predictor import load_predictor
from runtime.optics.pupil import PUPIL_MM
from runtime.optics.real.cells import Cell, Curve
from runtime.optics.real.panels import RealPanels
from runtime.optics.real.trace import Tables, crossings
from runtime.optics.stack import PanelStack
from runtime.optics.views import image_from_camera, stack_from_eye
from runtime.records import F32
from runtime.report.crosstalk import (
    FALL_DB,
    NEAR_M,
    Crosstalk,
    Patches,
    freedom_with_tracking,
    freedom_without_tracking,
    reduced,
    uniformity,
)
from runtime.report.page import Figure, Page, PageSection, Table, describe, drawing, png
from runtime.report.pairs import PairPainter, StillPair, eyes_at, read_pairs
from runtime.report.tolerance import (
    IMPERFECTIONS,
    MONITOR_CD_M2,
    PIXELS,
    PIXELS_FIRST,
    Bench,
    Cost,
    PanelMaker,
    Subject,
    cell_at,
    filters_of,
    late_front,
    monitor_share,
    slow_panels,
    solved,
    together,
)

SCENE, DISTANCE_M, HEIGHT_M = "room", 0.6, 0.03  # content and head position without --pairs
LOOKS = {33: "hard to distinguish from the target", 27: "a good picture with faint traces of the other layers",
         21: "obvious ghosts and coloured edges", -math.inf: "the layers fall apart"}  # fmt: skip
BACKLIGHT_FALLOFF = 0.2
REFRESH_MS = 1e3 / 60
CROP_PX = (160, 120)  # width and height of the part in the middle of the left eye's picture that is shown
RAYS_PASSED = 18  # rays per pixel that pass all panels, about
CURVES: tuple[Curve, Curve] = ("intensity", "angle")  # grey curve calibrated without and with the angles
Progress = Callable[[str], None]
NOTE = (
    "No real stack has been measured. The figures come from a simulator of real panels that leaves out oblique "
    "incidence in the cells, coherent effects between panels, spectra within a band and temperature. The page Planning "
    "a display in the documentation says what to order and what to measure first."
)


class ToleranceRun:
    """A run's results. Every new part is written to the folder, if there is one."""

    def __init__(self, out: Path | None, command: str, progress: Progress) -> None:
        self._out, self._command, self._progress = out, command, progress
        self._sections: dict[str, PageSection] = {}
        self.record: dict[str, Any] = {"complete": False}
        self._begun_s = time.perf_counter()

    def run(self, config: Path | None, pairs: Path | None, distance_m: float = DISTANCE_M) -> dict[str, Any]:
        """Measure everything, and return the contents of tolerance.json. Raises InputError for configuration
        or pairs, and MissingPart if a scene must be drawn without OpenGL.
        """
        self._progress("drawing the pictures")
        if pairs:
            subjects_pairs = read_pairs(pairs)
            stack = subjects_pairs[0].stack
        else:
            stack = load_settings(config).stack.stack()
            subjects_pairs = [scene_pair(stack, distance_m, source=config or "tolerance")]
        self._progress("solving")
        bench = Bench([solved(pair) for pair in subjects_pairs])
        self.record |= {"ideal_db": bench.ideal_db, "stack": geometry(stack), "pairs": [p.name for p in subjects_pairs]}
        self.record["distance_m"] = [float(pair.eyes_m[:, 0].mean()) for pair in subjects_pairs]
        self._measure_costs(bench, stack, first=True)
        self._measure_compensation(bench)
        self._measure_crosstalk(stack, subjects_pairs[0])
        self._measure_costs(bench, stack, first=False)
        self._measure_freedom(bench, stack, drawn=pairs is None)
        self._draw(bench)
        self.record |= {"complete": True, "seconds": time.perf_counter() - self._begun_s, "machine": describe()}
        self._write()
        return self.record

    def _measure_costs(self, bench: Bench, stack: PanelStack, *, first: bool) -> None:
        costs: list[Cost] = []
        for cost in bench.first(IMPERFECTIONS) if first else bench.curves(IMPERFECTIONS):
            costs.append(cost)
            self._progress(f"{'first look' if first else 'curves'}: {cost.imperfection.name} ({len(costs)}"
                           f"/{len(IMPERFECTIONS)})")  # fmt: skip
        pixels = PIXELS_FIRST if first else PIXELS
        self._progress("all imperfections together")
        both = [partial(together, IMPERFECTIONS, left=left) for left in (False, True)]
        assumed_db, left_db = bench.lights(both, pixels)
        self.record["costs"] = [cost_entry(cost, bench.ideal_db) for cost in costs]
        self.record["together"] = {
            "assumed": assumption(stack), "assumed_db": assumed_db, "left_db": left_db,
            "monitor_share": monitor_share(stack), "white_cd_m2": MONITOR_CD_M2 * monitor_share(stack),
        }  # fmt: skip
        self._sections["costs"] = cost_section(costs, bench.ideal_db, is_first=first)
        self._write()

    def _measure_compensation(self, bench: Bench) -> None:
        self._progress("compensation")
        found = compensations()
        lights = bench.lights([make for _, *both in found for make in both], PIXELS)
        both_db = list(zip([name for name, _, _ in found], lights, lights))  # before and after
        self.record["compensation"] = [
            {"name": name, "before_db": before_db, "after_db": after_db} for name, before_db, after_db in both_db
        ]
        shown = [[name, *(f"{db:.2f}" for db in (before, after, after - before))] for name, before, after in both_db]
        angles = [row for row in shown if "full white" in row[0]]
        given = ["panels", "grey calibrated, 90 and 0 degrees assumed, dB", "and the angles given, dB", "gained, dB"]
        known = ["panels", "delay unknown to the alignment, dB", "known, dB", "gained, dB"]
        tables = [Table(given, angles), Table(known, shown[len(angles) :])]
        self._sections["compensation"] = PageSection(
            "Compensation",
            ["First table: calibrate grey has measured the panels' grey curves (if not: Tolerances). It takes black "
             "and full white for 0 and 90 degrees unless --white-deg and --black-deg give the angles; then every "
             "rotation within the panel's range is right. Second table: the alignment aims at the time when each panel "
             "shows its picture, if delay_ms of a late panel and loop.scanout_ms (with the response) are set."],
            tables=tables,
        )  # fmt: skip
        self._write()

    def _measure_crosstalk(self, stack: PanelStack, pair: StillPair) -> None:
        small = reduced(stack)
        predictor = load_predictor("balanced", small, ModelSettings(backend="cpu"))
        try:
            patches = Patches(small, pair.eyes_m, predictor)
            self._progress("crosstalk by size of a patch")
            sizes = list(patches.sizes())
            self._progress("crosstalk by disparity")
            disparities = list(patches.disparities())
        finally:
            predictor.close()
        self.record["crosstalk"] = [asdict(found) for found in sizes]
        self.record["crosstalk_disparity"] = [asdict(found) for found in disparities]
        self.record["full_field_crosstalk_percent"] = sizes[-1].percent
        self.record["luminance_uniformity"] = uniformity(BACKLIGHT_FALLOFF)
        self._sections["crosstalk"] = crosstalk_section(sizes, disparities)
        self._write()

    def _measure_freedom(self, bench: Bench, stack: PanelStack, *, drawn: bool) -> None:
        subject = bench.subjects[0]
        self._progress("viewing freedom without tracking")
        still = freedom_without_tracking(subject.pair, subject.layers)
        self._progress("viewing freedom with tracking")
        followed = list(freedom_with_tracking(stack, SCENE)) if drawn else None
        self.record["viewing_freedom"] = {"without_tracking": still, "with_tracking": followed}
        self._sections["freedom"] = freedom_section(still, followed or ())

    def _draw(self, bench: Bench) -> None:
        self._progress("drawing what the left eye sees")
        subject = bench.subjects[0]
        both = [together(IMPERFECTIONS, subject.pair.stack, left=left) for left in (False, True)]
        lights = bench.ideal_db, self.record["together"]["assumed_db"], self.record["together"]["left_db"]
        kinds = zip(("ideal panels", "mounted by hand", "and calibrated"), lights, (RealPanels(), *both))
        figure = seen_figure(subject, [(f"{name}, {db:.1f} dB", panels) for name, db, panels in kinds])
        self._sections["seen"] = PageSection("What the left eye sees", figures=[figure])

    def _write(self) -> None:
        if self._out is None:
            return
        done = self.record["complete"]
        notes = [NOTE] if done else ["This page is not finished; results are added as they come in.", NOTE]
        lead = " ".join(summary(self.record))
        sections = [self._sections[name] for name in ORDER if name in self._sections]
        page = Page("What real panels would show", lead, sections, describe(), self._command, notes)
        page.write(self._out, data=self.record, data_name="tolerance.json")


ORDER = ("seen", "costs", "compensation", "crosstalk", "freedom")


def scene_pair(stack: PanelStack, distance_m: float = DISTANCE_M, source: str | Path = "tolerance") -> StillPair:
    """Draw the built-in scene for a viewer in front of the stack.

    Raises InputError, which names `source`, if the front panel is not in front of the viewer.
    """
    eyes_m = eyes_at(distance_m=distance_m, height_m=HEIGHT_M)
    if eyes_m[:, 0].min() < stack.x_m[-1] + NEAR_M:
        problem = f"the front panel is at {stack.x_m[-1]:g} m, but the viewer's eyes are at {eyes_m[:, 0].min():.3g} m"
        raise InputError(source, "stack.x_m", problem)
    with PairPainter(SCENE, stack) as painter:
        return painter.pair(f"{SCENE}, {distance_m:g} m", eyes_m, off_mm=())


def geometry(stack: PanelStack) -> dict[str, Any]:
    """Return a stack's geometry as entries for tolerance.json."""
    names = ("width_m", "height_m", "x_m", "width_px", "height_px")
    return {name: getattr(stack, name) for name in names} | {"colour": filters_of(stack)}


def assumption(stack: PanelStack) -> str:
    """Return in words which panels the figures for all imperfections together assume."""
    coloured = [str(n) for n, has_filters in enumerate(filters_of(stack)) if has_filters]
    filters = (
        "all panels" if len(coloured) == stack.count else f"panel {' and '.join(coloured)}" if coloured else "no panel"
    )
    return f"cells that act as rotators, colour filters on {filters}, mounted by hand, not calibrated"


def looks(light_db: float) -> str:
    """Return what light looks like, in words."""
    return next(words for least_db, words in LOOKS.items() if light_db > least_db)


def summary(record: dict[str, Any]) -> list[str]:
    """Return the main results in sentences."""

    def told(light_db: float) -> str:
        return f"{light_db:.1f} dB ({looks(light_db)})"

    places, stack = ", ".join(f"{metres:.2g} m" for metres in record["distance_m"]), record["stack"]
    lines = [
        f"{len(stack['x_m'])} panels of {stack['width_m']:g} x {stack['height_m']:g} m and {stack['width_px']} x "
        f"{stack['height_px']} pixels, at {', '.join(f'{x:g}' for x in stack['x_m'])} m.",
        f"Light on ideal panels, from {places}, at a tracking error of 1 mm: {told(record['ideal_db'])}.",
    ]
    if found := record.get("together"):
        lines += [
            f"As assumed ({found['assumed']}): {told(found['assumed_db'])}.",
            f"The same panels after registration and calibration: {told(found['left_db'])}.",
            f"Full white is {found['monitor_share']:.0%} of the rear monitor's: {found['white_cd_m2']:.0f} cd/m² if "
            f"that shows {MONITOR_CD_M2:.0f} cd/m².",
        ]
    return lines


def compensations() -> list[tuple[str, PanelMaker, PanelMaker]]:
    """Return compensations as name, panels before and panels after."""
    rows: list[tuple[str, PanelMaker, PanelMaker]] = []
    for white, black in ((85.0, 0.0), (80.0, 0.0), (70.0, 0.0), (90.0, 2.0), (90.0, 6.0), (80.0, 4.0)):
        before, after = (partial(_of_cell, cell_at(white, black, curve)) for curve in CURVES)
        rows.append((f"full white {white:g} degrees, black {black:g} degrees", before, after))
    for name, make in ((f"front panel {REFRESH_MS:.1f} ms late", late_front), ("time constant 10 ms", slow_panels)):
        ms = REFRESH_MS if make is late_front else 10.0
        for speed_m_s in (0.1, 0.3):
            before, after = (partial(make, ms, allowed=allowed, head_m_s=speed_m_s) for allowed in (False, True))
            rows.append((f"{name}, head at {speed_m_s:g} m/s", before, after))
    return rows


def _of_cell(cell: Cell, _: PanelStack) -> RealPanels:
    return RealPanels(cells=(cell,))


def cost_entry(cost: Cost, ideal_db: float) -> dict[str, Any]:
    """Return an imperfection's entry for tolerance.json."""
    one = cost.imperfection
    return {
        "name": one.name, "unit": one.unit, "sizes": one.sizes if cost.light_db else [], "light_db": cost.light_db,
        "costs_1_db_at": cost.costs_1_db_at(ideal_db), "assumed": one.assumed, "choices": one.choices,
        "assumed_costs_db": ideal_db - cost.assumed_db, "remedy": one.remedy, "left_costs_db": ideal_db - cost.left_db,
        "assumed_name": one.named(one.assumed), "note": one.note,
    }  # fmt: skip


def decibels(value: float) -> str:
    """Format a cost, without a sign before 0.0."""
    return f"{round(value, 1) + 0.0:.1f}"


def cost_section(costs: Sequence[Cost], ideal_db: float, *, is_first: bool) -> PageSection:
    """Return the table of imperfections, sorted by cost, with their curves."""
    ordered = sorted(costs, key=lambda cost: cost.assumed_db)
    rows = []
    for cost in ordered:
        one = cost.imperfection
        at = cost.costs_1_db_at(ideal_db)
        after = decibels(ideal_db - cost.left_db) if one.remedy else ""
        rows.append([
            one.name, one.named(one.assumed), decibels(ideal_db - cost.assumed_db),
            "" if at is None else f"{at:.2g} {one.unit}", one.remedy, after, one.note,
        ])  # fmt: skip
    headings = ["imperfection", "assumed", "costs, dB", "costs 1 dB at", "remedy", "then costs, dB", "note"]
    text = [
        "Each imperfection alone, on layers computed for ideal panels. Shifts and the like concern the front panel "
        "only; all others concern every panel. Light is measured as in solve.json, with the same rays with and without "
        "the imperfection, at about "
        f"{PIXELS_FIRST if is_first else PIXELS} pixels of each picture at the panels' full resolution.",
        "Costs do not add up. Twisted nematic cells are left out of the figures for all together, because a stack "
        "needs cells that act as rotators.",
    ]
    figures = [] if is_first else [cost_figure(ordered, ideal_db)]
    return PageSection("Tolerances", text, figures, [Table(headings, rows)])


def cost_figure(costs: Sequence[Cost], ideal_db: float) -> Figure:
    """Plot light against the size of each imperfection."""
    columns = 4
    rows = math.ceil(len(costs) / columns)
    lowest = max(min(min(cost.light_db) for cost in costs), 5.0)
    with drawing(12.0, 2.5 * rows) as figure:
        grid = figure.subplots(rows, columns, squeeze=False, sharey=True)
        for axes, cost in zip(grid.flat, costs, strict=False):
            one = cost.imperfection
            if one.unit:
                axes.plot(one.sizes, cost.light_db, "o-", markersize=3.5)
                axes.axvline(one.assumed, color="C1", linewidth=1, linestyle="--")
            else:
                colours = ["C1" if size == one.assumed else "C0" for size in one.sizes]
                axes.bar(one.sizes, cost.light_db, color=colours, width=0.6)
                axes.set_xticks(one.sizes, [fill(name, 11) for name in one.choices])
            axes.axhline(ideal_db - 1, color="grey", linewidth=0.8, linestyle=":")
            axes.set_ylim(lowest - 1, ideal_db + 1.5)
            axes.set_title(one.name, fontsize=9)
            axes.set_xlabel(one.unit, fontsize=8)
            axes.tick_params(labelsize=8 if one.unit else 5.5)
            axes.tick_params(axis="y", labelsize=8)
        for axes in grid.flat[len(costs) :]:
            axes.set_axis_off()
        for row in grid:
            row[0].set_ylabel("light, dB", fontsize=8)
        told = "Dotted: 1 dB below ideal panels. Orange: as assumed."
        return Figure("costs", png(figure), told)


def crosstalk_section(sizes: Sequence[Crosstalk], disparities: Sequence[Crosstalk]) -> PageSection:
    """Return the crosstalk curves."""
    with drawing(10.0, 3.8) as figure:
        axes = figure.subplots(1, 2, sharey=True)
        groups = (
            (sizes, [c.patch_mm for c in sizes], "size of a patch that one eye sees, mm"),
            (disparities, [c.disparity_mm or 0.0 for c in disparities], "disparity of a patch 60 mm wide, mm"),
        )
        for plot, (found, at, label) in zip(axes, groups, strict=True):
            plot.semilogx(at, [c.percent for c in found], "o-", label="solved")
            if found[0].theory_percent is not None:
                plot.semilogx(at, [c.theory_percent for c in found], "x--", color="C1", label="theory")
            plot.set_xticks(at, [f"{mm:g}" for mm in at])
            plot.minorticks_off()
            plot.set_xlabel(label)
        axes[0].set_ylabel("crosstalk, %")
        axes[0].legend()
        picture = Figure("crosstalk", png(figure), "Crosstalk on ideal panels, at a tracking error of 1 mm.")
    text = [
        "Crosstalk is the luminance that the wrong eye sees, divided by that for the right eye; both less black, which "
        "is 0 here. IEC 62629-22-1 and the IDMS measure it with patches that fill the display: white for one eye and "
        f"black for the other. By that measure it is {sizes[-1].percent:.0f} %. This kind of display cannot show large "
        "areas that differ between the eyes. What scenes in depth need are differences as wide as their disparity.",
        f"Luminance uniformity at nine points, for a backlight {100 * BACKLIGHT_FALLOFF:.0f} % darker in the corners: "
        f"{100 * uniformity(BACKLIGHT_FALLOFF):.0f} % (lowest / highest). The layers do not change it.",
    ]
    rows = [[f"{c.patch_mm:.0f} mm, one eye", f"{c.percent:.1f}", _percent(c.theory_percent)] for c in sizes]
    rows += [
        [f"disparity {c.disparity_mm:.0f} mm", f"{c.percent:.1f}", _percent(c.theory_percent)] for c in disparities
    ]
    return PageSection("Crosstalk", text, [picture], [Table(["patch", "crosstalk, %", "theory, %"], rows)])


def _percent(value: float | None) -> str:
    return "" if value is None else f"{value:.1f}"


def freedom_section(still: dict[str, Any], followed: Sequence[dict[str, float]]) -> PageSection:
    """Return the region in which light stays good, with and without tracking."""
    rows = []
    for name, found in still.items():
        falls = found["falls_3_db_at_mm"]
        rows.append([name, f"more than {found['mm'][-1]:g}" if falls is None else f"{falls:.1f}"])
    tables = [Table(["the head moves", f"light falls by {FALL_DB:g} dB at, mm"], rows, "Without tracking")]
    if followed:
        places = [[f"{f['distance_m']:g} m, {f['angle_deg']:g} degrees", f"{f['light_db']:.1f}"] for f in followed]
        tables.append(Table(["head", "light, dB"], places, "With tracking: layers computed for each place"))
    text = [
        "Without tracking, the eyes must stay close to where the layers were computed for. Tracking frees the head."
    ]
    return PageSection("Viewing freedom", text, tables=tables)


def seen_through(
    subject: Subject, real: RealPanels, rays: int = RAYS_PASSED, size_px: tuple[int, int] = CROP_PX
) -> F32:
    """Return a crop of the left eye's view through panels, relative to full white, from 0 to 1."""
    pair, random = subject.pair, np.random.default_rng(2)
    stack, eye_m, pose = pair.stack, pair.eyes_m[0], stack_from_eye(pair.eyes_m[0])
    height, width = pair.images[0].shape[:2]
    focal_px = image_from_camera(width_px=width, height_px=height, fov_deg=pair.fov_deg)[0, 0]
    columns, rows = min(size_px[0], width), min(size_px[1], height)
    corner = np.array([(height - rows) // 2, (width - columns) // 2])
    v, u = np.mgrid[0:rows, 0:columns].reshape(2, -1) + corner[:, None]
    tables, light, white = Tables(subject.layers, stack, real), np.zeros((len(u), 3)), np.zeros((len(u), 3))
    for _ in range(math.ceil(rays / real.optics.passed)):
        place = random.random((2, len(u)))
        radius = PUPIL_MM / 2e3 * np.sqrt(random.random(len(u)))
        angle = 2 * np.pi * random.random(len(u))
        start_m = eye_m + np.outer(radius * np.cos(angle), pose[:3, 0]) + np.outer(radius * np.sin(angle), pose[:3, 1])
        gaze = np.stack([u + place[0] - width / 2, height / 2 - v - place[1]], -1) / focal_px
        gaze = gaze @ pose[:3, :2].T - pose[:3, 2]
        middle_m = eye_m + gaze * ((stack.x_m[stack.count // 2] - eye_m[0]) / gaze[:, :1])
        both = tables.light(crossings(start_m, middle_m, stack, real, random), float(eye_m[0]))
        light, white = light + both[0], white + both[1]
    veil = real.lighting.veil
    seen = (light / white.mean(axis=0) + veil) / (1 + veil)
    return np.asarray(seen.reshape(rows, columns, 3).clip(0, 1), np.float32)


def seen_figure(subject: Subject, panels: Sequence[tuple[str, RealPanels]]) -> Figure:
    """Return a figure of the left eye's view through each of the named panels."""
    with drawing(12.0, 3.2) as figure:
        for axes, (name, real) in zip(figure.subplots(1, len(panels)), panels, strict=True):
            axes.imshow(seen_through(subject, real), interpolation="nearest")
            axes.set(xticks=[], yticks=[])
            axes.set_title(name, fontsize=10)
        return Figure("seen-left", png(figure), "The middle of what the left eye sees.")
