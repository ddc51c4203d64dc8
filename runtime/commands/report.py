"""`phasestack report`: error against run time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from runtime.report.methods import Method


def report(
    out: Annotated[Path, typer.Option(help="folder for report.json, the plots and index.html")] = Path("report"),
    pairs: Annotated[Path | None, typer.Option(help="folder of case files: pairs of one's own to measure on")] = None,
    focal: Annotated[bool, typer.Option("--focal", help="focal stacks through the layers as well")] = False,
    model: Annotated[list[str] | None, typer.Option(help="a further ONNX file to compare; may be repeated")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="quarter-size panels, fewer references: a first look")] = False,
    compare: Annotated[
        bool, typer.Option("--compare/--no-compare", help="the published network and other precisions (needs torch)")
    ] = True,
    fresh: Annotated[bool, typer.Option("--fresh", help="measure again what a stopped run had measured")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="print one JSON object")] = False,
) -> None:
    """Measure quality against run time, in one run on this machine, and write a page of it. Takes minutes.

    Where it is stopped, what it has measured is kept, and the same command goes on from there.

    The published network is compared with untrained weights (time and memory only) where torch is installed, and
    with its own as `--model FILE.onnx`.

    Example: phasestack report --pairs my-pairs --out report
    """
    from rich.console import Console

    from runtime.report.assemble import whole_report
    from runtime.report.progress import status_line
    from runtime.support.artifacts import to_json

    parts = ["phasestack report", *([f"--pairs {pairs.name}"] if pairs else []), *(["--focal"] if focal else [])]
    parts += [f"--model {Path(name).name}" for name in model or []] + (["--quick"] if quick else [])
    parts += [] if compare else ["--no-compare"]
    with _kept_where_stopped(), status_line("report") as tell:
        done = whole_report(
            pairs=pairs,
            with_focal=focal,
            models=model or [],
            quick=quick,
            command=" ".join(parts),
            variants=_variants if compare and not quick else lambda width_px, height_px: [],
            progress=tell,
            fresh=fresh,
        )
    done.page.write(out, record="report.json", data=done.record)
    done.forget()
    if as_json:
        print(to_json(done.record))
        return
    console = Console(highlight=False)
    console.print(done.page.lead, soft_wrap=True)
    for result in sorted(done.record["methods"], key=lambda r: r["ms_p50"]):
        size = f"{result['width_px']}x{result['height_px']}"
        expected = "".join(f"{value:8.2f} dB at {sigma} mm" for sigma, value in result["expected_db"].items())
        shown = f"{result['psnr_db']:8.2f} dB exact{expected}{result['worst_eye_psnr_db']:8.2f} dB worst eye"
        console.print(
            f"{result['name']:18}{size:>11}{result['ms_p50']:10.1f} ms"
            f"{shown if result['trained'] else '  untrained: no picture':73}{result['memory_mib']:7.0f} MiB",
            soft_wrap=True,
        )
    if earlier := done.record.get("parts_of_an_earlier_run"):
        console.print(f"{len(earlier)} parts were measured by an earlier run, which was stopped", soft_wrap=True)
    console.print(f"see {out / 'index.html'}")


@contextmanager
def _kept_where_stopped() -> Iterator[None]:
    """Says what a stopped run leaves."""
    try:
        yield
    except KeyboardInterrupt:
        typer.echo("report: stopped; what is measured is kept, and the same command goes on from there", err=True)
        raise


def _variants(width_px: int, height_px: int) -> list[Method]:
    """The published network and the shipped ones in fp16, made once and kept; none where torch isn't installed."""
    import importlib.metadata
    import importlib.util

    if any(importlib.util.find_spec(name) is None for name in ("torch", "onnx")):
        return []
    import model_export
    from model_export import yardstick
    from runtime.report.methods import SHIPPED, Method
    from runtime.support.cache import digest, user_cache

    code = Path(model_export.__file__).parent
    versions = [importlib.metadata.version(name) for name in ("torch", "onnx", "onnxruntime")]
    published = [code / name for name in ("eyereal.py", "onnx_files.py", "yardstick.py")]
    ours = sorted([*code.glob("*.py"), *code.glob("recipes/*.json")])
    large, small = (user_cache("models") / digest(sources, versions) for sources in (published, ours))
    found = []
    for name, precision in yardstick.PUBLISHED:
        path = large / f"eyereal-{precision}-{width_px}x{height_px}.onnx"
        size = {"width_px": width_px, "height_px": height_px}
        if _made(name, path, yardstick.write_eyereal, precision=precision, **size):
            found.append(Method(name, "network", str(path), trained=False))
    for name in SHIPPED:
        path = small / f"{name}-fp16.onnx"
        if _made(f"{name} fp16", path, yardstick.write_half, name=name):
            found.append(Method(f"{name} fp16", "network", str(path)))
    return found


def _made(what: str, path: Path, make: Callable[..., None], **options: Any) -> bool:
    """False, told on stderr, where it cannot be made (too little memory, say): the report goes on without it."""
    from runtime.errors import FatalError
    from runtime.report.worker import apart

    try:
        if not path.is_file():
            apart(make, path, **options)
    except FatalError as error:
        typer.echo(f"phasestack: {what} is left out: {error}", err=True)
        return False
    return True
