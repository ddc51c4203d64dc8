"""`phasestack stability`: test every numerical method on stiff and extreme cases."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from runtime.support.options import JsonOption

if TYPE_CHECKING:
    from runtime.records import F64
    from runtime.report.stability.calibration import Fit


def stability(
    out: Annotated[Path | None, typer.Option(help="folder to write stability.json to")] = None,
    full: Annotated[bool, typer.Option("--full", help="also run the long cases, which take minutes")] = False,
    as_json: JsonOption = False,
    record: Annotated[
        Path | None,
        typer.Option(help="file to save the measured errors to as new limits (use this after changing a model)"),
    ] = None,
) -> None:
    """Run every numerical method on stiff and extreme cases and compare the results with references.

    If a case has no reference, its error may exceed the recorded limit by up to 5%. Exits with 1 if any case fails.

    Example: phasestack stability --out stability
    """
    import time
    from contextlib import ExitStack
    from dataclasses import asdict

    from runtime.report.page import describe
    from runtime.report.stability import suite
    from runtime.support.artifacts import OutputFolder, to_json, write_json
    from runtime.support.progress import progress_bar

    started = time.perf_counter()
    trials = list(suite.every_trial(_fits(), full=full))
    with ExitStack() as cleanup:
        folder = None if out is None else cleanup.enter_context(OutputFolder(out))  # refused before any case has run
        with progress_bar("stability") as tell:
            cases = suite.run(trials, record=record, progress=tell)
        seconds = time.perf_counter() - started
        failed = [case for case in cases if not case.passed]
        result = {"cases": [asdict(case) for case in cases], "machine": describe(), "seconds": round(seconds, 1)}
        if folder is not None:
            write_json(folder.staging / "stability.json", result)
    if as_json:
        print(to_json(result))
    else:
        for stage in dict.fromkeys(case.stage for case in cases):
            own = [case for case in cases if case.stage == stage]
            refused = sum(case.behaviour == "refuses" for case in own)
            bad = sum(not case.passed for case in own)
            print(f"{stage:14}{len(own):4} cases {refused:4} refused {bad:4} failed")
        for case in failed:
            error = f"error {case.forward_error:.2g}, tolerance {case.tolerance:.2g} ({case.measure})"
            print(f"FAILS {case.stage}: {case.name}: {case.behaviour}, {error} {case.note}")
        verdict = f"{len(failed)} of {len(cases)} cases failed" if failed else f"all {len(cases)} cases passed"
        print(f"{verdict} in {seconds:.0f} s" + (f"; see {out / 'stability.json'}" if out else ""))
    if failed:
        raise typer.Exit(1)


def _fits() -> dict[str, Fit]:
    """Return, for each calibration method, a function that fits a 4x4 matrix to pairs of points."""
    from functools import partial

    from calib.solution import METHODS, Method, solve

    def matrix(sensor_m: F64, stack_m: F64, *, method: Method) -> F64:
        return solve(sensor_m, stack_m, method=method).similarity.matrix

    return {method: partial(matrix, method=method) for method in METHODS}
