"""`calibrate methods`: the methods' error table, its plots, and their run times."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from calib.experiment import DEFAULT, SIGMAS_M, Case, run_case, time_solvers
from calib.figures import methods_figure, timing_figure
from runtime.report.page import Figure, Page, in_columns, section_of
from runtime.report.progress import tracked

COUNTS = (3, 10, 27, 100, 1000, 10_000, 100_000, 1_000_000)
SENSOR_SCALES_OFF = (0.95, 1.03, 1.1)


def compare_methods(out: Path, *, seeds: int, pairs_max: int) -> tuple[dict[str, Any], str]:
    """Write `methods.json`, PNGs and `index.html`; answers the summary and a table for people."""
    setups: dict[str, tuple[str, dict[str, Any]]] = {
        "clean": ("Noise alone; both frames truly in metres", {}),
        **{
            f"scale-{scale:g}": (f"The sensor's metre is off: true scale {scale:g}", {"sensor_scale": scale})
            for scale in SENSOR_SCALES_OFF
        },
        "outliers": ("Every fifth pair grossly wrong (10 to 50 cm)", {"outliers": True}),
    }
    work = [(name, sigma) for name in setups for sigma in SIGMAS_M]
    cases: dict[str, list[Case]] = {name: [] for name in setups}
    for name, sigma in tracked("noise samples", work):
        cases[name].append(run_case(sigma_m=sigma, seeds=seeds, **setups[name][1]))
    timings = time_solvers([count for count in COUNTS if count <= pairs_max])
    summary = {
        "seeds": seeds,
        "cases": {name: [asdict(case) for case in found] for name, found in cases.items()},
        "timings": [asdict(timing) for timing in timings],
        "default_over_best": {name: [_over_best(case) for case in found] for name, found in cases.items()},
    }
    tables = {setups[name][0]: _rows(found) for name, found in cases.items()}
    tables["Run time"] = [["solver", "pairs", "ms (median)", "error at the eye, mm"]] + [
        [t.method, f"{t.pairs:,}", f"{t.ms_p50:.3f}", f"{t.error_m * 1e3:.3f}"] for t in timings
    ]
    figures = [
        Figure(f"methods-{name}", methods_figure(found, title=setups[name][0]), setups[name][0])
        for name, found in cases.items()
    ]
    figures.append(Figure("time", timing_figure(timings), "Error against run time"))
    sections = [
        replace(section_of(title, rows), figures=[figure])
        for (title, rows), figure in zip(tables.items(), figures, strict=True)
    ]
    lead = (
        f"27 viewpoints, {seeds} noise samples for each sigma, each with a camera turned at random; error of the "
        "calibrated position over the viewing volume (0.3 to 0.9 m, 25 degrees to each side), mm: mean (95th "
        "percentile)."
    )
    Page("Methods of calibration", lead, sections).write(out, record="methods.json", data=summary)
    return summary, "\n\n".join(f"{title}\n{in_columns(rows)}" for title, rows in tables.items())


def _over_best(case: Case) -> float:
    best = min(value for name, value in case.mean_m.items() if name != DEFAULT)
    return case.mean_m[DEFAULT] / best if best > 1e-12 else 1.0


def _rows(cases: list[Case]) -> list[list[str]]:
    names = list(cases[0].mean_m)
    header = ["sigma, mm", *names]
    return [header] + [
        [f"{case.sigma_m * 1e3:g}"]
        + [f"{case.mean_m[name] * 1e3:.3g} ({case.p95_m[name] * 1e3:.3g})" for name in names]
        for case in cases
    ]
