"""`phasestack tolerance`: what real panels would show, and how exactly a stack must be built."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from runtime.support.options import JsonOption


def tolerance(
    config: Annotated[
        Path | None, typer.Option(help="configuration file whose [stack] is to be built (default: the default stack)")
    ] = None,
    pairs: Annotated[
        Path | None, typer.Option(help="folder containing case files for your own stereo pairs, with their panels")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="folder for index.html, tolerance.json and the plots [default: tolerance]")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Measure the cost of each imperfection of real panels, crosstalk, and viewing freedom.

    The layers are computed for ideal panels, then seen through simulated real ones. The page is written after the first
    look, and completed as the curves are measured. The sizes assumed are those of three 27-inch monitors that are
    mounted by hand.

    Example: phasestack tolerance --config phasestack.toml --out tolerance
    """
    from runtime.report.tolerance_page import ToleranceRun
    from runtime.support.artifacts import refuse_file, to_json
    from runtime.support.progress import status_line

    folder = out or (None if as_json else Path("tolerance"))
    if folder is not None:
        refuse_file(folder)
    parts = ["phasestack tolerance", *([f"--config {config.name}"] if config else [])]
    parts += [f"--pairs {pairs.name}"] if pairs else []
    try:
        with status_line("tolerance") as tell:
            record = ToleranceRun(folder, " ".join(parts), tell).run(config, pairs)
    except KeyboardInterrupt:
        if folder is not None:
            typer.echo(f"tolerance: interrupted; the results so far are in {folder / 'index.html'}", err=True)
        raise
    if as_json:
        print(to_json(record))
        return
    for cost in sorted(record["costs"], key=lambda cost: -cost["assumed_costs_db"]):
        at = cost["costs_1_db_at"]
        size = f"{cost['assumed']:g} {cost['unit']}".strip()
        limit = "" if at is None else f"1 dB at {at:.2g} {cost['unit']}"
        left = f"  {cost['left_costs_db']:5.1f} dB after {cost['remedy']}" if cost["remedy"] else ""
        print(f"{cost['name']:40}{size:>12} costs {cost['assumed_costs_db']:5.1f} dB  {limit:32}{left}")
    print(f"ideal panels {record['ideal_db']:.1f} dB, all together {record['together']['assumed_db']:.1f} dB, "
          f"with the remedies {record['together']['left_db']:.1f} dB")  # fmt: skip
    print(f"crosstalk of the full field: {record['full_field_crosstalk_percent']:.0f} %")
    print(f"see {folder / 'index.html'}" if folder else "")
