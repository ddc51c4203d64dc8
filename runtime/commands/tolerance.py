"""`phasestack tolerance`: what real panels would show, and how exactly a stack must be built."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from runtime.support.options import JsonOption, number


def tolerance(
    config: Annotated[Path | None, typer.Option(help="configuration whose [stack] is to be built")] = None,
    pairs: Annotated[Path | None, typer.Option(help="folder of case files, which replaces --config")] = None,
    out: Annotated[Path | None, typer.Option(help="folder for index.html and tolerance.json")] = None,
    distance_m: Annotated[float | None, number(0.05, 50.0, "m", help="distance of the viewer (default: 0.6)")] = None,
    as_json: JsonOption = False,
) -> None:
    """Measure the cost of each imperfection of real panels, crosstalk, and viewing freedom.

    The layers are computed for ideal panels, then seen through simulated real ones. The page is written after the first
    look, and completed as the curves are measured. The sizes assumed are those of 27-inch monitors that are mounted by
    hand, with colour filters as in stack.colour.

    Example: phasestack tolerance --config phasestack.toml --out tolerance
    """
    from runtime.errors import InputError
    from runtime.report.tolerance_page import DISTANCE_M, ToleranceRun
    from runtime.support.artifacts import refuse_unwritable, to_json
    from runtime.support.progress import status_line

    for option, value in (("--config", config), ("--distance-m", distance_m)):
        if pairs is not None and value is not None:
            raise InputError(
                "tolerance", option, "the case files of --pairs define the panels and eyes; omit one of them"
            )
    folder = out or (None if as_json else Path("tolerance"))
    if folder is not None:
        refuse_unwritable(folder)
    parts = ["phasestack tolerance", *([f"--config {config.name}"] if config else [])]
    parts += [f"--pairs {pairs.name}"] if pairs else []
    parts += [f"--distance-m {distance_m:g}"] if distance_m else []
    try:
        with status_line("tolerance") as tell:
            record = ToleranceRun(folder, " ".join(parts), tell).run(config, pairs, distance_m or DISTANCE_M)
    except KeyboardInterrupt:
        if folder is not None:
            typer.echo(f"tolerance: interrupted; the results so far are in {folder / 'index.html'}", err=True)
        raise
    if as_json:
        print(to_json(record))
        return
    print("\n".join(told(record)))
    print(f"see {folder / 'index.html'}" if folder else "")


def told(record: dict[str, Any]) -> Iterator[str]:
    """Yield the lines to print for the contents of tolerance.json."""
    from runtime.report.tolerance_page import decibels, summary

    costs = sorted(record["costs"], key=lambda cost: -cost["assumed_costs_db"])
    shown = [cost for cost in costs if decibels(cost["assumed_costs_db"]) != "0.0"]
    for cost in shown:
        at = cost["costs_1_db_at"]
        limit = "" if at is None else f"1 dB at {at:.2g} {cost['unit']}"
        left = f"  {decibels(cost['left_costs_db']):>4} dB after {cost['remedy']}" if cost["remedy"] else ""
        size, cost_db = cost["assumed_name"], decibels(cost["assumed_costs_db"])
        yield f"{cost['name']:34}{size:>24} costs {cost_db:>4} dB  {limit:20}{left}".rstrip()
    yield f"{len(costs) - len(shown)} other imperfections cost less than 0.05 dB as assumed"
    yield from summary(record)
    patches = {round(found["patch_mm"]): found["percent"] for found in record["crosstalk"]}
    small = ", ".join(f"{percent:.0f} % for {mm} mm" for mm, percent in list(patches.items())[:-1] if mm in (4, 10, 20))
    yield f"crosstalk of a patch that one eye sees: {small}, {record['full_field_crosstalk_percent']:.0f} % for all"
    moves = record["viewing_freedom"]["without_tracking"].items()
    falls = ", ".join(f"{found['falls_3_db_at_mm'] or found['mm'][-1]:.1f} mm {name}" for name, found in moves)
    yield f"without tracking, light falls by 3 dB at {falls}"
