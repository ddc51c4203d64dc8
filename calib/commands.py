"""`phasestack calibrate`: panels, grey curves and the sensor's pose. Heavy imports are deferred."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from runtime.errors import InputError
from runtime.support.options import number
from runtime.support.ranges import SCALE

if TYPE_CHECKING:
    from runtime.config import Settings

ConfigOption = Annotated[Path | None, typer.Option(help="configuration (TOML); without one, the defaults")]
JsonOption = Annotated[bool, typer.Option("--json", help="one JSON object on stdout")]

app = typer.Typer(
    no_args_is_help=True,
    help="Run the steps of `phasestack setup` one by one: the panels' poses, their grey curves, the camera's pose.\n\n"
    "Run them in this order: `panels`, `grey`, `charts`, `capture`, `solve`, `report`.\n\n"
    "Example: phasestack calibrate charts --out charts",
)


@app.command()
def panels(
    out: Annotated[Path | None, typer.Option(help="folder for the registration")] = None,
    photos: Annotated[Path | None, typer.Option(help="folder with 8 to 20 photographs of the boards")] = None,
    show: Annotated[bool, typer.Option("--show", help="show the boards on the panels until Enter or q")] = False,
    write: Annotated[bool, typer.Option("--write", help="write distances, tilts and homographies to --config")] = False,
    config: ConfigOption = None,
    as_json: JsonOption = False,
) -> None:
    """Measure every panel's pose from photographs of coded boards, with standard errors.

    First show the boards with --show. In a dim room, take 8 to 20 hand-held photographs with one camera and one zoom
    setting, so that the display fills most of the picture: from the middle, the left, the right, above and below, up to
    40 degrees off the axis, and a few with the camera rotated to portrait. Then pass their folder as --photos.

    Example: phasestack calibrate panels --photos photos --config phasestack.toml --write --out registration
    """
    if show == (photos is not None) or (photos is not None and out is None):
        raise InputError("calibrate panels", "--show", "give either --show, or --photos with --out")
    if write and (config is None or photos is None):
        raise InputError("calibrate panels", "--write", "requires --config and --photos")
    settings = _settings(config)
    if photos is not None and out is not None:
        from calib.photographs import photographs
        from calib.registration import register_photos

        target = config if write else None
        _report(register_photos(photographs(photos), str(photos), out, settings, config=target), as_json)
        return
    from calib.board import boards
    from calib.display import grey_layers, open_display, show_until_key

    layers = grey_layers(boards(settings.stack.stack()))
    show_until_key(open_display(settings), layers, "the boards of all panels")


@app.command()
def grey(
    out: Annotated[Path | None, typer.Option(help="the panel's LUT, CSV")] = None,
    panel: Annotated[int, typer.Option(help="0 is the rear panel", min=0)] = 0,
    photos: Annotated[Path | None, typer.Option(help="folder with two or three photographs of the chart")] = None,
    show: Annotated[bool, typer.Option("--show", help="show the chart on the panel until Enter or q")] = False,
    config: ConfigOption = None,
    as_json: JsonOption = False,
) -> None:
    """Measure one panel's grey curve and write its inverse as a LUT.

    First show the chart with --show. In a dark room, photograph it with any camera from two or three positions. Lock
    the exposure, keep the whole chart in the picture, and avoid clipped whites. Then pass the photographs' folder as
    --photos.

    Example: phasestack calibrate grey --panel 2 --photos photos --out panel-2.csv
    """
    if show == (photos is not None) or (photos is not None and out is None):
        raise InputError("calibrate grey", "--show", "give either --show, or --photos with --out")
    settings = _settings(config)
    stack = settings.stack.stack()
    if panel >= stack.count:
        raise InputError("calibrate grey", "--panel", f"must be 0 to {stack.count - 1}")
    if photos is not None and out is not None:
        from calib.grey_chart import lut_from_photographs
        from calib.photographs import photographs

        _report(lut_from_photographs(out, photographs(photos), stack, panel=panel, source=str(photos)), as_json)
        return
    from calib.display import grey_layers, open_display, show_until_key
    from calib.grey_chart import grey_charts

    display = open_display(settings, grey_curve=False)
    show_until_key(display, grey_layers(grey_charts(stack, panel)), f"the chart of panel {panel}")


@app.command()
def charts(
    out: Annotated[Path, typer.Option(help="folder for the charts")],
    config: ConfigOption = None,
    as_json: JsonOption = False,
) -> None:
    """Draw the calibration charts, whose lines fuse only when the eyes are at the chart's viewpoint.

    Example: phasestack calibrate charts --out charts
    """
    from calib.charts import make_charts
    from calib.viewpoints import grid

    settings = _settings(config)
    _report(make_charts(out, grid(settings.calibration), settings), as_json)


@app.command()
def capture(
    out: Annotated[Path, typer.Option(help="CSV file for the pairs; an existing one is resumed")],
    config: ConfigOption = None,
    replay: Annotated[
        str | None, typer.Option(help="recording to use instead of the sensor; `demo` for the built-in one")
    ] = None,
    show: Annotated[bool, typer.Option("--show", help="show the charts on the panels")] = False,
    as_json: JsonOption = False,
) -> None:
    """Pair each chart's viewpoint with the measured eyes. Every accepted pair is saved immediately.

    With a live sensor, move until the lines of the chart fuse, then press Enter. Press n for the next chart, p to go
    back and replace a pair, q to stop. A recording must contain true eye positions, as the demo does.

    Example: phasestack calibrate capture --config /etc/phasestack/phasestack.toml --show --out pairs.csv
    """
    from calib.capture import capture_live, capture_recording
    from calib.hardware import SetupHardware
    from calib.keys import TerminalKeys

    settings = _settings(config)
    if replay is not None:
        summary = capture_recording(out, settings, source=replay)
    else:
        keys = TerminalKeys()
        hardware = SetupHardware(keys.poll)
        try:
            summary = capture_live(out, settings, hardware, show=show, say=lambda text: typer.echo(text, err=True))
        finally:
            keys.close()
            hardware.close()
    _report(summary, as_json)


@app.command()
def solve(
    pairs: Annotated[Path, typer.Option(help="CSV or JSON file with sensor_x.., stack_x.. in metres")],
    out: Annotated[Path, typer.Option(help="calibration file (TOML); a previous one is kept next to it")],
    method: Annotated[
        str, typer.Option(help="seed, least-squares, inverse, robust or fixed-scale; default: the best for the pairs")
    ] = "",
    scale: Annotated[float, number(*SCALE, help="the known scale for fixed-scale")] = 1.0,
    config: ConfigOption = None,
    as_json: JsonOption = False,
) -> None:
    """Compute stack_from_sensor from pairs, and the expected error at the eye.

    Inadequate pairs are refused.
    Example: phasestack calibrate solve --pairs pairs.csv --out calibration.toml
    """
    from calib.solve_run import solve_file

    _report(solve_file(pairs, out, settings=_settings(config), method=method, known_scale=scale), as_json)


@app.command()
def report(
    file: Annotated[Path, typer.Argument(help="calibration file (TOML)")],
    out: Annotated[Path, typer.Option(help="folder for index.html and its pictures")],
    config: ConfigOption = None,
    as_json: JsonOption = False,
) -> None:
    """Write a page with a calibration's figures and error plots.

    Example: phasestack calibrate report calibration.toml --out report
    """
    from calib.report import write_report

    summary = write_report(file, out, viewing=_settings(config).calibration)
    _report({"page": str(out / "index.html")} | summary, as_json)


def _settings(config: Path | None) -> Settings:
    from runtime.config import load_settings

    return load_settings(config)


def _report(summary: dict[str, Any], as_json: bool) -> None:
    """Print a command's summary as one JSON object, or one line per field."""
    from runtime.support.artifacts import to_json
    from runtime.support.figures import shown

    typer.echo(shown(json.loads(to_json(summary)), as_json=as_json))
