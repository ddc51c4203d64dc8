"""`phasestack calibrate`: the sensor's place before the stack. Nothing heavy is imported before it is needed."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from calib.options import ConfigOption, JsonOption, PanelsOption, settings_and_stack, tell
from calib.panel_commands import app as panels_app
from runtime.errors import InputError
from runtime.support.options import number
from runtime.support.ranges import SCALE

if TYPE_CHECKING:
    from runtime.config import Settings

app = typer.Typer(
    no_args_is_help=True,
    help="Find where the depth camera stands before the stack, and where the panels really are.\n\n"
    "The order is `charts`, `capture`, `solve`, `report`; but first the panels themselves: `panels`.\n\n"
    "Example: phasestack calibrate charts --out charts",
)
app.add_typer(panels_app, name="panels")


@app.command()
def charts(
    out: Annotated[Path | None, typer.Option(help="folder for the charts")] = None,
    kind: Annotated[str, typer.Option(help="solved (both eyes at once, all panels) or seed (one eye, one panel)")] = (
        "solved"
    ),
    show: Annotated[bool, typer.Option("--show", help="show them on the panels, one after the other")] = False,
    viewpoint: Annotated[list[str] | None, typer.Option(help="only this one, as R40-phi70-theta80; repeatable")] = None,
    check: Annotated[bool, typer.Option("--check", help="measure how well each solved chart fuses, dB")] = False,
    ipd_mm: Annotated[float, number(5, 100, "mm", help="the observer's eye separation, mm")] = 60.0,
    model: Annotated[str, typer.Option(help="model that solves the charts, or sart")] = "best",
    panels: PanelsOption = None,
    config: ConfigOption = None,
    as_json: JsonOption = False,
) -> None:
    """Draw the calibration charts: lines that fuse only when the eyes are at the chart's viewpoint.

    Example: phasestack calibrate charts --out charts --viewpoint R50-phi80-theta90
    """
    from calib.chart_files import Drawer, make_charts, show_charts

    if out is None and not show:
        raise InputError("calibrate charts", "--out", "is missing (or give --show)")
    if kind not in ("solved", "seed"):
        raise InputError("calibrate charts", "--kind", f"must be solved or seed, not {kind}")
    if check and (kind == "seed" or out is None):
        raise InputError("calibrate charts", "--check", "measures solved charts that are written: give --out")
    settings, stack = settings_and_stack(config, panels)
    chosen = _viewpoints("calibrate charts", viewpoint, settings)
    drawer = Drawer(stack, kind=kind, ipd_m=ipd_mm / 1000, model=model, settings=settings.model)  # type: ignore[arg-type]
    try:
        if out is not None:
            summary = make_charts(out, chosen, drawer, check=check)
            tell(summary, as_json, f"{summary['files']} files for {len(chosen)} viewpoints in {out}{_fused(summary)}")
        if show:
            show_charts(settings, chosen, drawer)
    finally:
        drawer.close()


def _fused(summary: dict[str, Any]) -> str:
    """What --check found; empty where nothing was checked."""
    found = summary["psnr_db"]
    if not found:
        return ""
    worst = min(range(len(found)), key=lambda index: found[index])
    lines = "".join(
        f"\n  {name:24}{db:6.2f} dB" for name, db in zip(summary["viewpoints"], found, strict=True) if len(found) > 1
    )
    name = summary["viewpoints"][worst]
    middle = sorted(found)[len(found) // 2]
    return f"\nfused: {middle:.2f} dB at the median viewpoint, {found[worst]:.2f} dB at the worst ({name}){lines}"


@app.command()
def capture(
    out: Annotated[Path, typer.Option(help="CSV of pairs; an existing one is resumed")],
    config: ConfigOption = None,
    replay: Annotated[str | None, typer.Option(help="a recording instead of the live sensor; `demo`: built in")] = None,
    marks: Annotated[
        Path | None, typer.Option(help="CSV of seconds,viewpoint: when each chart was accepted in the recording")
    ] = None,
    viewpoint: Annotated[list[str] | None, typer.Option(help="only this one; repeatable")] = None,
    again: Annotated[bool, typer.Option("--again", help="also viewpoints that the file holds already")] = False,
    show: Annotated[bool, typer.Option("--show", help="show each chart on the panels")] = False,
    window_s: Annotated[float, number(0.01, 10, "s", help="median over the last so many seconds")] = 0.5,
    max_spread_mm: Annotated[
        float, number(0.01, 1000, "mm", help="refuse a pair whose eyes moved or scattered by more")
    ] = 10.0,
    hold_s: Annotated[
        float,
        number(0, 10, "s", help="eyes held still for so long near the viewpoint are taken without a key; 0: never"),
    ] = 1.5,
    as_json: JsonOption = False,
) -> None:
    """Pair each chart's viewpoint with where the sensor sees the eyes. Every accepted pair is on disk at once.

    Live: at each chart move until the lines fuse, then press Enter (n: next, p: previous, u: undo, q: stop); after
    three places that are not on a line it says where to go, and holding still there is enough.
    A recording needs --marks, unless it knows its true eyes, as the demo does.

    Example: phasestack calibrate capture --config /etc/phasestack/phasestack.toml --out pairs.csv
    """
    from calib.capture_run import capture_live, capture_recording

    if marks is not None and replay is None:
        raise InputError("calibrate capture", "--marks", "needs --replay")
    settings, stack = settings_and_stack(config)
    limits = {"window_s": window_s, "max_spread_m": max_spread_mm / 1000}
    if replay is not None:
        summary = capture_recording(out, settings, source=replay, marks=marks, **limits)
    else:
        chosen = _viewpoints("calibrate capture", viewpoint, settings)
        summary = capture_live(out, settings, chosen, stack=stack, show=show, again=again, hold_s=hold_s, **limits)
    tell(summary, as_json, f"{summary['pairs']} pairs in {out} ({summary['accepted']} new)")


@app.command()
def solve(
    out: Annotated[Path, typer.Option(help="calibration TOML; the one it replaces is kept beside it")],
    pairs: Annotated[Path | None, typer.Option(help="CSV or JSON of sensor_x.., stack_x.. in metres")] = None,
    method: Annotated[
        str, typer.Option(help="seed, least-squares, inverse, robust or fixed-scale; without: the best for the pairs")
    ] = "",
    scale: Annotated[float, number(*SCALE, help="the known scale of fixed-scale")] = 1.0,
    sensor_unit: Annotated[float, number(*SCALE, help="metres in one unit of the sensor's columns")] = 1.0,
    stack_unit: Annotated[float, number(*SCALE, help="metres in one unit of the stack's columns")] = 1.0,
    serial: Annotated[str, typer.Option(help="the sensor's serial; without: as the pairs' file says")] = "",
    config: ConfigOption = None,
    rollback: Annotated[bool, typer.Option("--rollback", help="put the past version of --out back")] = False,
    as_json: JsonOption = False,
) -> None:
    """Find stack_from_sensor from pairs, with its error at the eye; refuse pairs that cannot support it.

    Example: phasestack calibrate solve --pairs pairs.csv --out calibration.toml
    """
    if rollback:
        from calib.store import roll_back

        restored = roll_back(out)
        tell({"file": str(out), "restored": str(restored)}, as_json, f"{out} is {restored.name} again")
        return
    if pairs is None:
        raise InputError("calibrate solve", "--pairs", "is missing")
    from calib.solve_run import solve_file

    units = {"sensor_unit_m": sensor_unit, "stack_unit_m": stack_unit, "known_scale": scale}
    settings, _ = settings_and_stack(config)
    summary, text = solve_file(pairs, out, method=method, settings=settings, serial=serial, **units)
    for warning in summary["warnings"]:
        typer.echo(f"warning: {warning}", err=True)
    tell(summary, as_json, text)


@app.command()
def report(
    file: Annotated[Path, typer.Argument(help="a calibration TOML")],
    out: Annotated[Path, typer.Option(help="folder for index.html and its pictures")],
    pairs: Annotated[Path | None, typer.Option(help="the pairs, where the file does not hold them")] = None,
    config: ConfigOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show a calibration's error at every point, and camera, panels and points from above and from the side.

    Example: phasestack calibrate report calibration.toml --out report
    """
    from calib.report import write_report

    settings, stack = settings_and_stack(config)
    summary = write_report(file, out, pairs_path=pairs, stack=stack, viewing=settings.calibration)
    tell(summary, as_json, f"{out / 'index.html'}")


@app.command()
def methods(
    out: Annotated[Path, typer.Option(help="folder for the table and the plots")],
    seeds: Annotated[int, typer.Option(help="noise samples for each sigma", min=1, max=100_000)] = 200,
    pairs_max: Annotated[int, typer.Option(help="most pairs in the timing", min=27, max=1_000_000)] = 100_000,
    as_json: JsonOption = False,
) -> None:
    """Compare the methods on the EyeReal's synthetic experiment: error at the eye, and time, for each of them.

    Example: phasestack calibrate methods --out methods
    """
    from calib.methods_run import compare_methods

    summary, text = compare_methods(out, seeds=seeds, pairs_max=pairs_max)
    tell(summary, as_json, text)


def _viewpoints(command: str, names: list[str] | None, settings: Settings) -> tuple[Any, ...]:
    from calib.viewpoints import grid

    known = {viewpoint.name: viewpoint for viewpoint in grid(settings.calibration)}
    if not names:
        return tuple(known.values())
    for name in names:
        if name not in known:
            raise InputError(command, "--viewpoint", f"unknown: {name}; known: {min(known)} .. {max(known)}")
    return tuple(known[name] for name in dict.fromkeys(names))
