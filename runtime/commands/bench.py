"""`phasestack bench`: measure the models' quality and run time, or compare two such measurements."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from runtime.support.options import JsonOption

app = typer.Typer()


@app.callback(invoke_without_command=True)
def bench(
    context: typer.Context,
    out: Annotated[Path | None, typer.Option(help="write the measurement to this JSON file")] = None,
    as_json: JsonOption = False,
) -> None:
    """Measure the shipped models' run time, memory and light PSNR, or compare two measurements.

    Example: phasestack bench --out bench.json

    Example: phasestack bench compare old.json new.json
    """
    if context.invoked_subcommand is not None:
        return
    from contextlib import ExitStack

    from runtime.errors import InputError
    from runtime.report import benchmark
    from runtime.support.artifacts import OutputFolder, to_json, write_json
    from runtime.support.figures import lines_of
    from runtime.support.progress import status_line

    with ExitStack() as cleanup:
        folder = None
        if out is not None:  # refuse an unusable name before the measurement, not after it
            if out.is_dir():
                raise InputError(out, "--out", "is a folder; pass the name of a file")
            folder = cleanup.enter_context(OutputFolder(out.parent))
        with status_line("bench") as tell:
            record = benchmark.measured(progress=tell)
        if out is not None and folder is not None:
            write_json(folder.staging / out.name, record)
    print(to_json(record) if as_json else "\n".join(lines_of(record)))


@app.command()
def compare(
    old: Annotated[Path, typer.Argument(help="JSON file with the earlier measurement")],
    new: Annotated[Path, typer.Argument(help="JSON file with the later measurement")],
    as_json: JsonOption = False,
) -> None:
    """List every figure that changed by more than the noise. Exits with 1 if any figure got worse.

    If the machine was too busy during either measurement, times are not compared.

    Example: phasestack bench compare old.json new.json
    """
    from runtime.report import benchmark
    from runtime.support.artifacts import to_json

    before, after = benchmark.read(old), benchmark.read(new)
    changes = benchmark.compare(before, after)
    worse = [change for change in changes if change.worse]
    files = ((old, before), (new, after))
    busy = [f"{path}: {why}" for path, file in files if (why := benchmark.too_busy(file.yardsticks_ms))]
    if as_json:
        rows = [{"what": change.what, "worse": change.worse, "text": change.text} for change in changes]
        print(to_json({"worse": len(worse), "changes": rows, "times_compared": not busy, "too_busy": busy}))
    else:
        for why in busy:
            print(f"not comparing run times because the machine was too busy: {why}")
        speed = after.yardstick_ms / before.yardstick_ms
        print(f"the reference workload took {speed:.2f} times as long as before; solution times are scaled to match")
        for change in sorted(changes, key=lambda change: not change.worse):
            print(f"{'worse ' if change.worse else 'better'} {change.what}: {change.text}")
        again = " (run times could not be compared; measure again on an idle machine)" if busy else ""
        ends = f"{len(worse)} worse, {len(changes) - len(worse)} better"
        print(ends if changes else f"no figure changed by more than the noise{again}")
    if worse:
        raise typer.Exit(1)
