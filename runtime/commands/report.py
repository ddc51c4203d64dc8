"""`phasestack report`: error against run time."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def report(
    out: Annotated[Path, typer.Option(help="folder for report.json, the plots and index.html")] = Path("report"),
    pairs: Annotated[Path | None, typer.Option(help="folder of case files: pairs of one's own to measure on")] = None,
    focal: Annotated[bool, typer.Option("--focal", help="focal stacks through the layers as well")] = False,
    model: Annotated[list[str] | None, typer.Option(help="a further ONNX file to compare; may be repeated")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="quarter-size panels, fewer references: a first look")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="print one JSON object")] = False,
) -> None:
    """Measure quality against run time, in one run on this machine, and write a page of it. Takes minutes.

    Example: phasestack report --pairs my-pairs --out report
    """
    from rich.console import Console

    from runtime.artifacts import OutputFolder, to_json, write_json, write_text
    from runtime.report.assemble import whole_report
    from runtime.report.progress import status_line

    parts = ["phasestack report", *([f"--pairs {pairs.name}"] if pairs else []), *(["--focal"] if focal else [])]
    parts += [f"--model {Path(name).name}" for name in model or []] + (["--quick"] if quick else [])
    with status_line("report") as tell:
        done = whole_report(
            pairs=pairs, with_focal=focal, models=model or [], quick=quick, command=" ".join(parts), progress=tell
        )
    with OutputFolder(out) as folder:
        write_json(folder.staging / "report.json", done.record)
        write_text(folder.staging / "index.html", done.page.html())
        for figure in done.page.figures():
            (folder.staging / f"{figure.name}.png").write_bytes(figure.png)
    if as_json:
        print(to_json(done.record))
        return
    console = Console(highlight=False)
    console.print(done.page.lead, soft_wrap=True)
    for result in sorted(done.record["methods"], key=lambda r: r["ms_p50"]):
        size = f"{result['width_px']}x{result['height_px']}"
        console.print(
            f"{result['name']:18}{size:>11}{result['ms_p50']:10.1f} ms{result['psnr_db']:8.2f} dB"
            f"{result['worst_eye_psnr_db']:8.2f} dB worst eye{result['memory_mib']:7.0f} MiB",
            soft_wrap=True,
        )
    console.print(f"see {out / 'index.html'}")
