"""`phasestack bench`: the frontier's regression file, and the comparison of two of them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

app = typer.Typer(
    help="Measure what a frame costs, or compare two measurements. Example: phasestack bench --out new.json"
)


@app.callback(invoke_without_command=True)
def bench(
    context: typer.Context,
    out: Annotated[Path | None, typer.Option(help="write the regression file here (JSON)")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="print one JSON object")] = False,
) -> None:
    """Milliseconds a stage and the frontier of the shipped models, at 960x540 and 1920x1080.

    Example: phasestack bench --out bench.json

    Example: phasestack bench compare old.json new.json
    """
    if context.invoked_subcommand is not None:
        return
    from runtime.artifacts import to_json, write_json
    from runtime.report import benchmark
    from runtime.report.progress import status_line

    with status_line("bench") as tell:
        record = benchmark.measured(progress=tell)
    if out is not None:
        write_json(out, record)
    if as_json:
        print(to_json(record))
    else:
        _print(record, out)


@app.command()
def compare(
    old: Annotated[Path, typer.Argument(help="the earlier regression file")],
    new: Annotated[Path, typer.Argument(help="the later one")],
    as_json: Annotated[bool, typer.Option("--json", help="print one JSON object")] = False,
) -> None:
    """Name what got slower or worse beyond noise. Exits with 1 where anything did.

    Example: phasestack bench compare old.json new.json
    """
    from rich.console import Console

    from runtime.artifacts import to_json
    from runtime.report import benchmark

    before, after = benchmark.read(old), benchmark.read(new)
    changes = benchmark.compare(before, after)
    worse = [change for change in changes if change.worse]
    if as_json:
        rows = [{"what": change.what, "worse": change.worse, "text": change.text} for change in changes]
        print(to_json({"worse": len(worse), "changes": rows}))
    else:
        console = Console(highlight=False)
        speed = after["yardstick_ms"] / before["yardstick_ms"]
        console.print(f"machine: {speed:.2f} times the time of the yardstick; frame times are compared net of it")
        for change in sorted(changes, key=lambda change: not change.worse):
            verdict = "worse " if change.worse else "better"
            console.print(f"{verdict} {change.what}: {change.text}", style="red" if change.worse else "green")
        console.print(
            f"{len(worse)} worse, {len(changes) - len(worse)} better" if changes else "no change beyond noise"
        )
    if worse:
        raise typer.Exit(1)


def _print(record: dict[str, Any], out: Path | None) -> None:
    names = list(dict.fromkeys(name for entry in record["stages"] for name in entry["stage_ms"]))
    columns = [*names, "frame ms", "PSNR dB", "2 mm off", "MiB"]
    print(f"{'':19}" + "".join(f"{column:>11}" for column in columns))
    for stages, method in zip(record["stages"], record["methods"], strict=True):
        numbers = [stages["stage_ms"].get(name, 0.0) for name in names]
        numbers += [stages["total_ms"], method["psnr_db"], method["psnr_db_off_eye"]["2mm"], method["memory_mib"]]
        name = f"{stages['name']} {stages['width_px']}x{stages['height_px']}"
        print(f"{name:19}" + "".join(f"{number:11.1f}" for number in numbers))
    written = f"; written to {out}" if out else ""
    print(f"yardstick of this machine: {record['yardstick_ms']:.1f} ms{written}")
