"""The whole report: what is measured, in which order, and the page and record that come of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from runtime.config import StackGeometry
from runtime.report import focal, horizon, latency, moving, sweeps
from runtime.report.backends_section import backends_section
from runtime.report.focal_page import focal_section
from runtime.report.frontier import MethodResult, check_models, measure
from runtime.report.frontier_page import frontier_section
from runtime.report.kept import KeptParts
from runtime.report.machine import describe
from runtime.report.methods import Method, shipped_and_references
from runtime.report.moving_page import moving_section
from runtime.report.page import Page, Section, Tile
from runtime.report.pairs import StillPair, eyes_at, procedural_pairs, read_pairs
from runtime.report.plan_section import surveyed
from runtime.report.simulate import Simulation
from runtime.report.sweep_page import gap_section, resolution_section, tolerance_section, trade_section, volume_section
from runtime.report.worker import apart

MODELS = ("fast", "balanced", "best")
KNOB_DISTANCE_M = 0.45
OFFSETS_MM = tuple(range(-6, 7))
WHO = {"1": "a pupil (1 mm)", "2": "a pupil and a tracker (2 mm)"}
Progress = Callable[[str], None]
Variants = Callable[[int, int], list[Method]]  # further methods for panels so wide and high


@dataclass(frozen=True, slots=True)
class Report:
    """A page, and the same as a record."""

    page: Page
    record: dict[str, Any]
    forget: Callable[[], None]  # once it is written: what was kept for the case that it was stopped


def whole_report(
    *,
    pairs: Path | None,
    with_focal: bool,
    models: Sequence[str],
    quick: bool,
    command: str,
    variants: Variants = lambda width_px, height_px: [],
    progress: Progress = lambda name: None,
    fresh: bool = False,
) -> Report:
    """Measure everything. `quick`: quarter-size panels and fewer references, for a first look.

    What an earlier run of the same had measured before it was stopped is not measured again, unless `fresh`.

    variants: what else to compare on panels of a size, such as models made for it.

    Raises InputError for case files and models with mistakes, before anything is measured.
    """
    cases = read_pairs(pairs) if pairs is not None else []
    check_models(models)
    stack = StackGeometry().stack()
    small = replace(stack, width_px=480, height_px=270)
    if quick:
        stack = replace(stack, width_px=960, height_px=540)

    # Everything that can fail at the start is done at the start.
    progress("models to compare with")
    sizes = {(one.width_px, one.height_px) for one in (stack, *(pair.stack for pair in cases))}
    further = {size: variants(*size) for size in sorted(sizes)}

    def methods(pair: StillPair) -> list[Method]:
        own = further[pair.stack.width_px, pair.stack.height_px]
        return shipped_and_references(models=models, variants=own, quick=quick)

    case_files = [path for path in sorted(pairs.iterdir()) if path.is_file()] if pairs is not None else []
    kept = KeptParts(
        "report", sources=[*case_files, *map(Path, models)], facts=(quick, with_focal, sorted(further)), fresh=fresh
    )
    record: dict[str, Any] = {"machine": describe(seed=0), "command": command}
    sections: list[Section] = []

    def tell(name: str) -> Callable[[int, int], None]:
        return lambda done, of: progress(f"{name} {done}/{of}")

    found: list[MethodResult] = []
    for name, own in _by_size(cases).items():
        results = measure(
            methods(own[0]),
            own,
            progress=tell(f"frontier, case files {name}"),
            keep=kept.of(f"case files {name}"),
        )
        found += results
        title = f"Error against run time: {len(own)} case file{'s' if len(own) > 1 else ''}, {name}"
        sections.append(
            frontier_section(results, pairs=", ".join(p.name for p in own), title=title, name=f"cases-{name}")
        )
    progress("drawing pairs")
    own_pairs = procedural_pairs(stack)
    results = measure(
        methods(own_pairs[0]),
        own_pairs,
        progress=tell("frontier, built-in scenes"),
        keep=kept.of("built-in scenes"),
    )
    text = "; ".join(pair.name for pair in own_pairs)
    title = "Error against run time: built-in scenes"
    sections.append(frontier_section(results, pairs=text, title=title, name="scenes"))
    record["methods"] = [r.record() for r in (found or results)]
    if found:
        record["methods_on_built_in_scenes"] = [r.record() for r in results]

    sections += _sweeps(record, stack=stack, small=small, progress=progress, kept=kept)
    progress("the daemon, plan on and off")
    scale = 0.25 if quick else 0.5
    runs = kept.part("daemon", lambda: latency.plan_on_and_off(frames=60 if quick else 150, scale=scale))
    sections.insert(len(sections) - 1, latency.latency_section(runs, scale=scale))
    record["runs"] = [{"name": run.name, "latency_ms": run.latency_ms, "summary": run.summary} for run in runs]
    progress("what scenes do not need")
    section, record["plan"] = kept.part("plan", lambda: surveyed(quick=quick))
    sections.insert(len(sections) - 1, section)
    progress("what a moving viewer sees")
    motions = moving.QUICK if quick else {}
    found_moving, strip = kept.part("moving", lambda: apart(moving.moving_runs, scale=scale, **motions))
    sections.insert(2 if cases else 1, moving_section(found_moving, strip))
    record["moving"] = [asdict(one) for one in found_moving]
    progress("OpenCV and OpenGL")
    section, record["backends"] = kept.part("backends", lambda: backends_section(MODELS, stack))
    sections.append(section)
    if with_focal:
        full = StackGeometry().stack()

        def focal_stack() -> focal.FocalStack:
            with focal.cards_painter(full) as painter:
                return focal.focal_stack(painter, full, model="best", progress=tell("focal stack"))

        stacks = [kept.part("focal", focal_stack)]
        sections += [focal_section(one) for one in stacks]
        record["focal"] = [_focal_record(one) for one in stacks]
    if kept.earlier:
        record["parts_of_an_earlier_run"] = kept.earlier
        record["machine"]["measured"] = f"{len(kept.earlier)} parts by an earlier run, which was stopped"
    return Report(_page(sections, found or results, record, command), record, kept.forget)


def _by_size(cases: Sequence[StillPair]) -> dict[str, list[StillPair]]:
    groups: dict[str, list[StillPair]] = {}
    for pair in cases:
        groups.setdefault(f"{pair.stack.width_px}x{pair.stack.height_px}", []).append(pair)
    return groups


def _sweeps(record: dict[str, Any], *, stack: Any, small: Any, progress: Progress, kept: KeptParts) -> list[Section]:
    distance_m = 0.6

    def viewing_volume() -> Any:
        with Simulation("demo", small, model="balanced") as simulation:
            return sweeps.viewing_volume(simulation)

    def tolerance_map() -> Any:
        with Simulation("demo", finer, model="balanced") as simulation:
            return sweeps.tolerance_map(simulation, eyes_at(distance_m=distance_m), OFFSETS_MM)

    progress("viewing volume")
    volume = kept.part("viewing volume", viewing_volume)
    # On small panels a pixel is millimetres: there, no eye is anywhere else.
    finer = stack if stack.width_px < 1920 else replace(stack, width_px=960, height_px=540)
    progress("tolerance to tracking errors")
    tolerance = kept.part("tolerance", tolerance_map)
    progress("tracker horizon")
    horizons = kept.part("horizons", horizon.all_motions)
    progress("exactness against tolerance")
    trades = kept.part(
        "exactness", lambda: sweeps.over_uncertainty("texture", finer, MODELS, distance_m=KNOB_DISTANCE_M)
    )
    progress("panel gap")
    gaps = kept.part("gaps", lambda: sweeps.over_gaps("demo", small, MODELS, distance_m=distance_m - 0.06))
    progress("resolution")
    sizes = kept.part("resolutions", lambda: sweeps.over_resolutions("demo", stack, MODELS, distance_m=distance_m))
    record["viewing_volume"] = {
        "angles_deg": volume.angles_deg,
        "distances_m": volume.distances_m,
        "psnr_db": volume.psnr_db,
        "expected_1mm_db": volume.expected_db,
    }
    record["tolerance"] = {"offsets_mm": tolerance.offsets_mm, "psnr_db": tolerance.psnr_db}
    record["horizon"] = [
        {
            "motion": h.motion,
            "horizons_ms": horizon.HORIZONS_MS,
            "tracked_mm": h.tracked_mm,
            "untracked_mm": h.untracked_mm,
        }
        for h in horizons
    ]
    record["uncertainty"] = [
        {
            "model": trade.name,
            "eye_sigma_mm": trade.solved_for_mm,
            "expected_db": {f"{sigma_mm:g}": values for sigma_mm, values in trade.psnr_db.items()},
        }
        for trade in trades
    ]
    record["gaps"] = [{"model": c.name, "gap_mm": c.x, "psnr_db": c.y, "expected_1mm_db": c.expected} for c in gaps]
    record["resolutions"] = [
        {
            "model": s.model,
            "width_px": s.width_px,
            "height_px": s.height_px,
            "ms": s.ms,
            "psnr_db": s.psnr_db,
            "expected_1mm_db": s.expected_db,
        }
        for s in sizes
    ]
    return [
        trade_section(
            trades, where=f"a full texture, {KNOB_DISTANCE_M:g} m away, at {finer.width_px}x{finer.height_px}"
        ),
        volume_section(volume, model="balanced", scene="demo"),
        tolerance_section(tolerance, model="balanced", distance_m=distance_m),
        horizon.horizon_section(horizons, tolerance),
        gap_section(gaps),
        resolution_section(sizes),
    ]


def _focal_record(stack: focal.FocalStack) -> dict[str, Any]:
    return {
        "model": stack.model,
        "pinhole_db": stack.pinhole_db,
        "slices": [
            {"plane_m": s.plane_m, "psnr_db": s.psnr_db, "contrast": s.contrast_shown, "contrast_true": s.contrast_true}
            for s in stack.slices
        ],
        "cards": [
            {"distance_m": c.card_m, "sharpest_m": c.sharpest_shown_m, "sharpest_true_m": c.sharpest_true_m}
            for c in stack.cards
        ],
    }


def _page(
    sections: list[Section],
    results: Sequence[MethodResult],
    record: dict[str, Any],
    command: str,
) -> Page:
    by_name = {result.name: result for result in results}
    balanced = by_name["balanced"]
    best = max((r for r in results if r.kind == "network" and r.trained), key=lambda r: r.psnr_db)
    references = [r for r in results if r.kind == "iterative"]
    as_good = [r for r in references if r.psnr_db >= balanced.psnr_db]
    tiles = [
        Tile(f"{balanced.psnr_db:.1f} dB", "balanced, exact: two points"),
        *(Tile(f"{value:.1f} dB", f"balanced, expected of {WHO[key]}") for key, value in balanced.expected_db.items()),
        Tile(f"{best.psnr_db:.1f} dB", f"{best.name}, exact"),
        Tile(f"{balanced.memory_mib:.0f} MiB", "balanced, peak"),
    ]
    published = by_name.get("eyereal")
    if published is not None:
        tiles.insert(0, Tile(f"1/{published.ms_p50 / balanced.ms_p50:.0f}", "of eyereal's time, balanced"))
    lead = f"The default model shows {balanced.psnr_db:.1f} dB to two points"
    lead += "".join(f", {value:.1f} dB to {WHO[key]}" for key, value in balanced.expected_db.items())
    if as_good:
        quickest = min(as_good, key=lambda r: r.ms_p50)
        ratio = quickest.ms_p50 / balanced.ms_p50
        tiles.insert(0, Tile(f"{ratio:.1f} ×", f"balanced is faster than {quickest.name}"))
        lead += f"; the first iterative method that is as good, {quickest.name}, takes {ratio:.1f} times as long."
    else:
        lead += ", which none of the iterative references reaches."
    return Page("Error against run time", lead, sections, record["machine"], command, tiles)
