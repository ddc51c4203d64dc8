"""Commands under `phasestack calibrate` that measure panels, grey curves and the sensor's pose."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from runtime.errors import InputError
from runtime.support.options import ConfigOption, JsonOption, number
from runtime.support.ranges import SCALE

if TYPE_CHECKING:
    from runtime.config import Settings

app = typer.Typer(
    no_args_is_help=True,
    help="Run the steps of `phasestack setup` one by one.\n\n"
    "Run them in this order: `panels`, `grey`, `charts`, `capture`, `solve`, `report`.\n\n"
    "Example: phasestack calibrate charts --out charts",
)


@app.command()
def panels(
    out: Annotated[Path | None, typer.Option(help="folder to write the registration to")] = None,
    photos: Annotated[Path | None, typer.Option(help="folder containing 8 to 20 photographs of the boards")] = None,
    show: Annotated[bool, typer.Option("--show", help="show the boards until Enter or q is pressed")] = False,
    write: Annotated[bool, typer.Option("--write", help="write the results to the --config file")] = False,
    config: ConfigOption = None,
    as_json: JsonOption = False,
) -> None:
    """Measure every panel's pose, with standard errors, from photographs of coded boards.

    First show the boards with --show. In a dim room, take 8 to 20 hand-held photographs, all with the same camera and
    zoom and with the display filling most of the picture. Take them from the middle, left, right, above and below, up
    to 40 degrees off the axis, and a few in portrait. Then pass their folder as --photos.

    Example: phasestack calibrate panels --photos photos --config phasestack.toml --write --out registration
    """
    if show == (photos is not None) or (photos is not None and out is None):
        raise InputError("calibrate panels", "--show", "pass either --show, or both --photos and --out")
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
    out: Annotated[Path | None, typer.Option(help="CSV file to write the LUT to")] = None,
    panel: Annotated[int, typer.Option(help="index of the panel (0 for the rear panel)", min=0)] = 0,
    photos: Annotated[Path | None, typer.Option(help="folder containing two or three photographs of the chart")] = None,
    show: Annotated[bool, typer.Option("--show", help="show the chart until Enter or q is pressed")] = False,
    white_deg: Annotated[float, number(1.0, 90.0, help="angle by which full white turns the polarization")] = 90.0,
    black_deg: Annotated[float, number(0.0, 89.0, help="angle by which black turns the polarization")] = 0.0,
    config: ConfigOption = None,
    as_json: JsonOption = False,
) -> None:
    """Measure one panel's grey curve for each colour channel and write their inverses as a LUT.

    First show the chart with --show. In a dark room, photograph it with any camera from two or three positions. Lock
    the exposure, keep the whole chart in the picture and avoid overexposure. Then pass the folder with the photographs
    as --photos. Photographs cannot show a panel's angles: find them with an analyser, and pass --white-deg and
    --black-deg.

    Example: phasestack calibrate grey --panel 2 --photos photos --config phasestack.toml --out panel-2.csv
    """
    if show == (photos is not None) or (photos is not None and out is None):
        raise InputError("calibrate grey", "--show", "pass either --show, or both --photos and --out")
    settings = _settings(config)
    stack = settings.stack.stack()
    if panel >= stack.count:
        raise InputError("calibrate grey", "--panel", f"must be from 0 to {stack.count - 1}")
    if photos is not None and out is not None:
        if black_deg >= white_deg:
            raise InputError("calibrate grey", "--black-deg", f"must be less than --white-deg, {white_deg:g}")
        from calib.grey_chart import AngleRange, lut_from_photographs
        from calib.photographs import photographs

        turns = AngleRange(black_deg, white_deg)
        pictures = photographs(photos, colour=True)
        _report(lut_from_photographs(out, pictures, stack, panel=panel, source=str(photos), turns=turns), as_json)
        return
    from calib.display import grey_layers, open_display, show_until_key
    from calib.grey_chart import grey_charts

    display = open_display(settings, grey_curve=False)
    show_until_key(display, grey_layers(grey_charts(stack, panel)), f"the chart of panel {panel}")


@app.command()
def charts(
    out: Annotated[Path, typer.Option(help="folder to write the charts to")],
    config: ConfigOption = None,
    as_json: JsonOption = False,
) -> None:
    """Draw the calibration charts. A chart's lines fuse only for eyes at its viewpoint.

    Example: phasestack calibrate charts --out charts
    """
    from calib.charts import make_charts
    from calib.viewpoints import grid

    settings = _settings(config)
    _report(make_charts(out, grid(settings.calibration), settings), as_json)


@app.command()
def capture(
    out: Annotated[Path, typer.Option(help="CSV file for the pairs (new pairs are appended to an existing file)")],
    config: ConfigOption = None,
    replay: Annotated[str | None, typer.Option(help="recording to use instead of the sensor, or `demo`")] = None,
    show: Annotated[bool, typer.Option("--show", help="show the charts on the panels")] = False,
    as_json: JsonOption = False,
) -> None:
    """Pair each chart's viewpoint with the measured eyes, and save every accepted pair immediately.

    With a live sensor, move until the chart's lines fuse, then press Enter. Press n for the next chart, p to go back
    and replace a pair, or q to stop. A recording must contain true eye positions, as the demo does.

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
    pairs: Annotated[Path, typer.Option(help="CSV or JSON file of pairs in metres (sensor_x, stack_x, ...)")],
    out: Annotated[Path, typer.Option(help="calibration file (TOML) to write (an existing file is backed up)")],
    method: Annotated[str, typer.Option(help="seed, least-squares, inverse, robust or fixed-scale")] = "",
    scale: Annotated[float, number(*SCALE, help="known scale (fixed-scale method only)")] = 1.0,
    config: ConfigOption = None,
    as_json: JsonOption = False,
) -> None:
    """Compute the sensor's pose (stack_from_sensor) from pairs. Fails if they do not determine it well.

    Example: phasestack calibrate solve --pairs pairs.csv --out calibration.toml
    """
    from calib.solve_run import solve_file

    _report(solve_file(pairs, out, settings=_settings(config), method=method, known_scale=scale), as_json)


@app.command()
def report(
    file: Annotated[Path, typer.Argument(help="calibration file (TOML)")],
    out: Annotated[Path, typer.Option(help="folder to write index.html and its pictures to")],
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
    """Print a command's summary as one JSON object or as one line per field."""
    from runtime.support.artifacts import to_json
    from runtime.support.figures import shown

    typer.echo(shown(json.loads(to_json(summary)), as_json=as_json))
