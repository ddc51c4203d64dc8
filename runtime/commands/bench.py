"""`phasestack bench`: the frontier's regression file, and the comparison of two of them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from runtime.report.pairs import StillPair

SHIPPED = ("fast", "balanced", "best")
ROBUST_SIZE = {"width_px": 480, "height_px": 270}
app = typer.Typer()


@app.callback(invoke_without_command=True)
def bench(
    context: typer.Context,
    out: Annotated[Path | None, typer.Option(help="write the regression file here (JSON)")] = None,
    backend: Annotated[str, typer.Option(help="what surrounds the network: opencv, gl or auto")] = "opencv",
    as_json: Annotated[bool, typer.Option("--json", help="print one JSON object")] = False,
) -> None:
    """Measure what a frame costs, or compare two measurements.

    It measures milliseconds a stage and the frontier of the shipped models, at 960x540 and 1920x1080.

    Example: phasestack bench --out bench.json

    Example: phasestack bench --backend gl --out gl.json

    Example: phasestack bench compare old.json new.json
    """
    if context.invoked_subcommand is not None:
        return
    from runtime.config import Settings, changed
    from runtime.report import benchmark
    from runtime.report.progress import status_line
    from runtime.support.artifacts import to_json, write_json

    wanted = changed(Settings(), "model", {"backend": backend}, source="--backend").model.backend
    with status_line("bench") as tell:
        record = benchmark.measured(backend=wanted, progress=tell)
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
    """Name what got slower or worse beyond noise. Exits with 1 where anything is named.

    Times are not compared where the machine was too busy in either measurement; that is said.

    Example: phasestack bench compare old.json new.json
    """
    from rich.console import Console

    from runtime.report import benchmark
    from runtime.support.artifacts import to_json

    before, after = benchmark.read(old), benchmark.read(new)
    changes = benchmark.compare(before, after)
    worse = [change for change in changes if change.worse]
    busy = [f"{path}: {why}" for path, file in ((old, before), (new, after)) if (why := benchmark.too_busy(file))]
    if as_json:
        rows = [{"what": change.what, "worse": change.worse, "text": change.text} for change in changes]
        print(to_json({"worse": len(worse), "changes": rows, "times_compared": not busy, "too_busy": busy}))
    else:
        console = Console(highlight=False)
        speed = after["yardstick_ms"] / before["yardstick_ms"]
        for why in busy:
            console.print(f"times are not compared, the machine was too busy: {why}", style="yellow", soft_wrap=True)
        console.print(
            f"machine: {speed:.2f} times the time of the yardstick; frame times are compared net of it", soft_wrap=True
        )
        for change in sorted(changes, key=lambda change: not change.worse):
            verdict = "worse " if change.worse else "better"
            console.print(
                f"{verdict} {change.what}: {change.text}", style="red" if change.worse else "green", soft_wrap=True
            )
        console.print(
            f"{len(worse)} worse, {len(changes) - len(worse)} better"
            if changes
            else "no change beyond noise" + (", but for times, which can't be compared: measure again" if busy else "")
        )
    if worse:
        raise typer.Exit(1)


@app.command()
def passes(
    model: Annotated[
        list[str] | None, typer.Option(help="shipped name or ONNX file; may be repeated (all shipped ones)")
    ] = None,
    width: Annotated[int, typer.Option(min=64, max=16384, help="columns of a panel")] = 1920,
    height: Annotated[int, typer.Option(min=64, max=16384, help="rows of a panel")] = 1080,
    each: Annotated[bool, typer.Option("--each", help="every pass of every solution")] = False,
    timed: Annotated[bool, typer.Option("--timed", help="with --each: what this GPU takes, by timer queries")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="print one JSON object")] = False,
) -> None:
    """What the OpenGL backend reads and writes for a solution, and how long memories of three speeds take for that.

    Counted while it solves: the driver's own time does not matter. The network itself is not in it.

    Example: phasestack bench passes --model balanced

    Example: phasestack bench passes --model fast --each --timed
    """
    from dataclasses import asdict

    from runtime.report import passes as account
    from runtime.report.frontier import check_models
    from runtime.report.progress import status_line
    from runtime.support.artifacts import to_json

    names = list(dict.fromkeys(model or SHIPPED))
    check_models([name for name in names if name not in SHIPPED])
    with status_line("passes"):
        found = account.counted(names, width_px=width, height_px=height, timed=timed)
    if as_json:
        rows = [asdict(one) | {"moved_bytes": one.moved_bytes} for one in found]
        print(to_json({"width_px": width, "height_px": height, "solutions": rows}))
        return
    print("\n".join(account.table(found)))
    for one in found if each else ():
        print(f"\n{one.model}, eyes unsure by {one.eye_sigma_mm:g} mm:")
        for step in one.passes:
            crosses = "  crosses" if step.crosses else ""
            moved = f"reads {step.read_bytes / 1e6:8.2f} MB, writes {step.written_bytes / 1e6:8.2f} MB"
            took = f"  {step.gpu_ms:9.3f} ms" if step.gpu_ms is not None else ""
            print(f"  {step.name:16} {step.width_px:5}x{step.height_px:<5} {moved}{took}{crosses}")
        if timed:
            print(
                f"  together {sum(step.gpu_ms or 0.0 for step in one.passes):.3f} ms on this GPU, without the network"
            )


@app.command()
def robust(
    pairs: Annotated[int, typer.Option(min=1, help="how many random pairs")] = 500,
    model: Annotated[
        list[str] | None, typer.Option(help="shipped name or ONNX file; may be repeated (all shipped ones)")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="of the pairs")] = 0,
    first: Annotated[int, typer.Option(min=0, help="number of the first pair: with --pairs 1, one of them alone")] = 0,
    cache: Annotated[Path | None, typer.Option(help="folder where pairs are kept (the user's cache)")] = None,
    out: Annotated[Path | None, typer.Option(help="folder for robust.json and robust.png")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="print one JSON object")] = False,
) -> None:
    """Random pairs of the whole design range against SART-30, at 480x270. Exits with 1 where a model fails.

    A model fails where it shows less than 28 dB of a pair of which SART-30 shows 32 or more, or where it is refused
    or answers with no number. Minutes the first time; pairs and what SART-30 shows of them are kept.

    Example: phasestack bench robust --model balanced --out robust
    """
    from dataclasses import asdict

    from rich.console import Console

    from runtime.report import robust as check
    from runtime.report.frontier import check_models
    from runtime.report.machine import describe
    from runtime.report.progress import progress_bar
    from runtime.report.robust_plot import robust_plot
    from runtime.support.artifacts import OutputFolder, to_json, write_json

    names = list(dict.fromkeys(model or SHIPPED))
    check_models([name for name in names if name not in SHIPPED])
    with progress_bar("robust") as tell:
        found = check.outcomes(
            _random_pairs(seed),
            range(first, first + pairs),
            models=names,
            cache=cache or _pairs_cache(seed),
            progress=tell,
        )
    verdicts = [check.verdict(found, name) for name in names]
    record = {
        "machine": describe(seed=seed),
        "reference": check.REFERENCE.name,
        "bar": {"poor_db": check.POOR_DB, "reached_db": check.REACHED_DB},
        "models": [asdict(one) for one in verdicts],
        "pairs": [outcome.record() for outcome in found],
    }
    if out is not None:
        figure = robust_plot(found)
        with OutputFolder(out) as folder:
            write_json(folder.staging / "robust.json", record)
            (folder.staging / f"{figure.name}.png").write_bytes(figure.png)
    failed = sum(len(one.failing) for one in verdicts)
    if as_json:
        print(to_json(record))
    else:
        console = Console(highlight=False)
        for one in verdicts:
            text = f"exact: median {one.median_db:.1f}, 5th percentile {one.p5_db:.1f}, least {one.least_db:.1f} dB; "
            text += f"a pupil (1 mm): {one.expected_median_db:.1f}, {one.expected_p5_db:.1f} dB; above"
            text += f" {check.REFERENCE.name} on {one.beats_reference:.0%}; {len(one.failing)} fail"
            console.print(f"{Path(one.model).stem:12}{text}", style="red" if one.failing else None, soft_wrap=True)
            for outcome in (outcome for outcome in found if outcome.number in one.failing):
                shown = outcome.models[one.model]
                said = (
                    shown.problem or f"{shown.psnr_db:.1f} dB, {check.REFERENCE.name} {outcome.reference.psnr_db:.1f}"
                )
                console.print(f"  pair {outcome.number}: {said}", soft_wrap=True)
        ends = f"all {len(found)} pairs pass" if not failed else f"{failed} failures in {len(found)} pairs"
        console.print(ends + (f"; see {out / 'robust.png'}" if out else ""), soft_wrap=True)
    if failed:
        raise typer.Exit(1)


def _random_pairs(seed: int) -> Callable[[int], StillPair]:
    from model_export.stills import random_still

    return lambda number: random_still(seed, number, **ROBUST_SIZE)


def _pairs_cache(seed: int) -> Path:
    """A folder of its own for each seed, and for each state of the code that draws and solves the pairs."""
    from model_export import data, scene, stills, textures
    from runtime.model import sart, still, unseen
    from runtime.support.cache import digest, user_cache

    modules = (data, scene, stills, textures, sart, still, unseen)
    return user_cache("pairs") / digest([Path(str(module.__file__)) for module in modules], seed, ROBUST_SIZE)


def _print(record: dict[str, Any], out: Path | None) -> None:
    names = list(dict.fromkeys(name for entry in record["stages"] for name in entry["stage_ms"]))
    columns = [*names, "frame ms", "exact dB", "1 mm dB", "2 mm dB", "MiB"]
    print(f"{'':19}" + "".join(f"{column:>11}" for column in columns))
    for stages, method in zip(record["stages"], record["methods"], strict=True):
        numbers = [stages["stage_ms"].get(name, 0.0) for name in names]
        numbers += [stages["total_ms"], method["psnr_db"], *method["expected_db"].values(), method["memory_mib"]]
        name = f"{stages['name']} {stages['width_px']}x{stages['height_px']}"
        print(f"{name:19}" + "".join(f"{number:11.1f}" for number in numbers))
    written = f"; written to {out}" if out else ""
    print(f"yardstick of this machine: {record['yardstick_ms']:.1f} ms{written}")
