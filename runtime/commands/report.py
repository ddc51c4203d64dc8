"""`phasestack report`: compare the methods by light PSNR and run time."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from runtime.support.options import JsonOption


def report(
    out: Annotated[Path, typer.Option(help="folder for index.html, report.json and the plots")] = Path("report"),
    pairs: Annotated[Path | None, typer.Option(help="folder containing case files for your own stereo pairs")] = None,
    only_pairs: Annotated[bool, typer.Option("--only-pairs", help="measure only the case files")] = False,
    layers: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="<path>", help="folder with another solver's layers and times for the case files (can be repeated)"
        ),
    ] = None,
    focal: Annotated[bool, typer.Option("--focal", help="also measure focal parallax through the layers")] = False,
    model: Annotated[
        list[str] | None, typer.Option(metavar="<path>", help="additional ONNX file to compare (can be repeated)")
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="smaller panels and fewer reference methods")] = False,
    processes: Annotated[int, typer.Option(min=1, max=1024, help="measurements at the same time")] = 1,
    as_json: JsonOption = False,
) -> None:
    """Measure every method's light PSNR and run time on this machine, and write a page with the results.

    This takes minutes. The page is written once the first result is in and is updated as each new result arrives.
    Pressing Ctrl-C stops the run but keeps the page written so far. To include the published network, convert its
    checkpoint with `phasestack export` and pass the converted file with --model.

    --layers takes a folder with CASE/layer-0.png (rear) and so on for every case file, and times.json with a time in ms
    for every case, such as {"case-1": 12.5}.

    Example: phasestack report --pairs my-pairs --only-pairs --layers my-solver --out report
    """
    from runtime.errors import FatalError, InputError
    from runtime.report.assemble import Own, whole_report
    from runtime.support.artifacts import refuse_unwritable, to_json
    from runtime.support.progress import status_line

    refuse_unwritable(out)
    if only_pairs and pairs is None:
        raise InputError("report", "--only-pairs", "requires --pairs")
    parts = ["phasestack report", *([f"--pairs {pairs.name}"] if pairs else []), *(["--focal"] if focal else [])]
    parts += [f"--model {Path(name).name}" for name in model or []]
    parts += [f"--layers {folder.name}" for folder in layers or []]
    parts += [*(["--only-pairs"] if only_pairs else []), *(["--quick"] if quick else [])]
    parts += [f"--processes {processes}"] if processes > 1 else []
    try:
        with status_line("report") as tell:
            record = whole_report(
                out,
                pairs=pairs,
                own=Own(processes, only_pairs, tuple(layers or ())),
                with_focal=focal,
                models=model or [],
                quick=quick,
                command=" ".join(parts),
                progress=tell,
            )
    except KeyboardInterrupt:
        typer.echo(f"report: interrupted; the measurements so far are in {out / 'index.html'}", err=True)
        raise
    failed = len(record.get("failed", []))
    if as_json:
        print(to_json(record))
    else:
        _print_table(record, out)
    if failed:
        raise FatalError(f"report: {failed} measurement{'s' if failed > 1 else ''} failed; the others are in {out}")


def _print_table(record: dict[str, Any], out: Path) -> None:
    for result in sorted(record["methods"], key=lambda r: (r["x_m"], r["width_px"], r["ms_p50"])):
        size = f"{len(result['x_m'])} panels {result['width_px']}x{result['height_px']}"
        light = result["light_db"].get("1", float("nan"))
        memory = "" if result["kind"] == "layers" else f" {result['memory_mib']:7.0f} MiB"
        print(
            f"{result['name']:18}{size:>20}{result['ms_p50']:10.1f} ms   "
            f"light {light:6.2f} dB, one ray {result['psnr_db']:6.2f} dB{memory}"
        )
    print(f"see {out / 'index.html'} (the figure to quote is the light PSNR, which assumes a tracking error of 1 mm)")
