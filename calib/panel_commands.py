"""`phasestack calibrate panels`: where the panels really are, and how grey they are. Nothing heavy at the top."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from calib.options import ConfigOption, JsonOption, PanelsOption, settings_and_stack, tell
from runtime.errors import InputError
from runtime.support.options import number, place

if TYPE_CHECKING:
    from runtime.optics.stack import PanelStack

app = typer.Typer(
    no_args_is_help=True,
    help="Register the panels with each other and measure their grey curves.\n\n"
    "With a camera: `board`, a dozen photographs of it, `photo`. Without one: the verniers, then `fit`.\n\n"
    "Example: phasestack calibrate panels photo --photos photos --config phasestack.toml --write --out panels\n\n"
    "Example: phasestack calibrate panels vernier --config phasestack.toml --eye 0.5 0 0 --out vernier.csv\n\n"
    "Example: phasestack calibrate panels fit --config phasestack.toml --vernier vernier.csv --write --out panels",
)

Point = tuple[float, float, float]
EyeOption = Annotated[Point, place(help="the marked viewpoint of one eye, X Y Z in metres before the stack")]
ReferenceOption = Annotated[int, typer.Option(help="the panel that the others are registered to; -1: the middle one")]
EYE: Point = (0.5, 0.0, 0.0)
LEFT_EYE: Point = (0.6, -0.03, 0.0)
RIGHT_EYE: Point = (0.6, 0.03, 0.0)


@app.command()
def charts(
    out: Annotated[Path, typer.Option(help="folder for the vernier charts")],
    eye: EyeOption = EYE,
    reference: ReferenceOption = -1,
    panels: PanelsOption = None,
    config: ConfigOption = None,
    as_json: JsonOption = False,
) -> None:
    """Draw the verniers of every pair of panels as PNGs, one per panel: halves of crosses that should meet.

    Example: phasestack calibrate panels charts --eye 0.5 0 0 --out verniers
    """
    from calib.panel_run import write_vernier_charts

    _, stack = settings_and_stack(config, panels)
    summary = write_vernier_charts(out, stack, eye_m=_eye(eye, stack), reference=_reference(reference, stack))
    tell(summary, as_json, f"{len(summary['files'])} files in {out}")


@app.command()
def vernier(
    out: Annotated[Path, typer.Option(help="CSV of settings; an existing one is resumed")],
    eye: EyeOption = EYE,
    reference: ReferenceOption = -1,
    panels: PanelsOption = None,
    config: ConfigOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show one vernier after the other on the panels; nudge with the arrows until its halves meet, then Enter.

    Look with one eye, the other shut, from the marked viewpoint. f and c: finer and coarser steps; n, p: next and
    previous; q: stop. Every setting is on disk at once.

    Example: phasestack calibrate panels vernier --config phasestack.toml --eye 0.5 0 0 --out vernier.csv
    """
    from calib.panel_run import nudge_verniers

    settings, stack = settings_and_stack(config, panels)
    summary = nudge_verniers(out, settings, stack, eye_m=_eye(eye, stack), reference=_reference(reference, stack))
    tell(summary, as_json, f"{summary['settings']} of {summary['asked']} settings in {out}")


@app.command()
def fit(
    vernier: Annotated[Path, typer.Option(help="CSV of vernier settings")],
    out: Annotated[Path, typer.Option(help="folder for registration.json, panels.toml, index.html")],
    reference: ReferenceOption = -1,
    write: Annotated[bool, typer.Option("--write", help="put the homographies into --config, keeping the old")] = False,
    panels: PanelsOption = None,
    config: ConfigOption = None,
    as_json: JsonOption = False,
) -> None:
    """Find a homography per panel from the settings, with its uncertainty.

    Example: phasestack calibrate panels fit --vernier vernier.csv --config phasestack.toml --write --out registration
    """
    from calib.panel_run import fit_registration

    if write and config is None:
        raise InputError("calibrate panels fit", "--write", "needs --config")
    settings, stack = settings_and_stack(config, panels)
    summary, text = fit_registration(
        vernier, out, settings, stack, reference=_reference(reference, stack), config=config if write else None
    )
    tell(summary, as_json, text)


@app.command("board")
def board_command(
    out: Annotated[Path | None, typer.Option(help="folder for the boards as PNGs, one a panel")] = None,
    show: Annotated[bool, typer.Option("--show", help="show them on the panels until Enter or q")] = False,
    panels: PanelsOption = None,
    config: ConfigOption = None,
    as_json: JsonOption = False,
) -> None:
    """Draw or show the coded boards that `photo` wants photographs of: all panels at once, their marks side by side.

    Take 8 to 20 photographs by hand (12 are plenty) with one camera, without zooming between them, the display
    filling most of the picture, the room dim: from the middle, the left, the right, above and below, up to 40 degrees
    aside, a few with the camera on its side. Nothing else need be done between them.

    Example: phasestack calibrate panels board --config phasestack.toml --show
    """
    if out is None and not show:
        raise InputError("calibrate panels board", "--out", "is missing (or give --show)")
    from calib.photo_run import show_board, write_board

    settings, stack = settings_and_stack(config, panels)
    if out is not None:
        summary = write_board(out, stack)
        tell(summary, as_json, f"{len(summary['files'])} boards in {out}")
    if show:
        show_board(settings, stack)


@app.command()
def photo(
    out: Annotated[Path, typer.Option(help="folder for registration.json, panels.toml, index.html")],
    photos: Annotated[Path | None, typer.Option(help="folder of photographs of the boards")] = None,
    device: Annotated[str | None, typer.Option(help="a video device (number or path) instead of photographs")] = None,
    count: Annotated[int, typer.Option(help="with --device: photographs to take", min=5, max=40)] = 12,
    spacing: Annotated[
        str,
        typer.Option(help="even or true distances; auto: true ones, unless too uneven for the configured model"),
    ] = "auto",
    write: Annotated[bool, typer.Option("--write", help="put distances, tilts and homographies into --config")] = False,
    model: Annotated[
        str, typer.Option(help="model that tells what the registration gains in dB; configured; empty: none")
    ] = "configured",
    panels: PanelsOption = None,
    config: ConfigOption = None,
    as_json: JsonOption = False,
) -> None:
    """Find where every panel is from photographs of the boards: distances, homographies, tilts, and how sure.

    With --device the boards are shown, and a photograph is taken whenever the camera is held still somewhere new.

    Example: phasestack calibrate panels photo --photos photos --config phasestack.toml --write --out registration
    """
    from calib.photo_run import register_folder, register_live, wants_even

    if (photos is None) == (device is None):
        raise InputError("calibrate panels photo", "--photos", "or --device is needed, one of them")
    if spacing not in ("auto", "even", "true"):
        raise InputError("calibrate panels photo", "--spacing", f"must be auto, even or true, not {spacing}")
    if write and config is None:
        raise InputError("calibrate panels photo", "--write", "needs --config")
    settings, stack = settings_and_stack(config, panels)
    chosen: dict[str, Any] = {
        "even": wants_even(settings, stack) if spacing == "auto" else spacing == "even",
        "model": settings.model.name if model == "configured" else model,
        "config": config if write else None,
    }
    if photos is not None:
        summary, text = register_folder(photos, out, settings, stack, **chosen)
    else:
        assert device is not None
        summary, text = register_live(device, out, settings, stack, wanted=count, **chosen)
    tell(summary, as_json, text)


@app.command("photo-trial")
def photo_trial(
    out: Annotated[Path, typer.Option(help="folder for trial.json and, with --photos, the photographs")],
    stacks: Annotated[int, typer.Option(help="random stacks", min=1, max=1000)] = 3,
    count: Annotated[int, typer.Option("--count", help="photographs of each, by hand", min=1, max=40)] = 12,
    seed: Annotated[int, typer.Option(min=0, help="of the first stack")] = 0,
    megapixels: Annotated[float, number(0.5, 50, help="of the phone's camera")] = 12.0,
    off_mm: Annotated[float, number(0, 20, "mm", help="panels and gaps are off by up to this")] = 2.0,
    turn_deg: Annotated[float, number(0, 30, "degrees", help="and turned about a random axis by up to this")] = 1.0,
    model: Annotated[str, typer.Option(help="model whose layers are judged; empty: geometry only")] = "",
    keep: Annotated[bool, typer.Option("--photos", help="keep the photographs: what `photo --photos` reads")] = False,
    panels: PanelsOption = None,
    config: ConfigOption = None,
    as_json: JsonOption = False,
) -> None:
    """Try the registration on simulated stacks: photographs with noise, distortion and moire, and the truth.

    Example: phasestack calibrate panels photo-trial --stacks 3 --out trial
    """
    from calib.photo_trial import run_trial

    settings, stack = settings_and_stack(config, panels)
    summary, text = run_trial(
        out, settings, stack, stacks=stacks, count=count, seed=seed, megapixels=megapixels, off_m=off_mm / 1000,
        turn_deg=turn_deg, model=model, keep=keep,
    )  # fmt: skip
    tell(summary, as_json, text)


@app.command()
def grey(
    out: Annotated[Path, typer.Option(help="the panel's LUT, CSV; its plot goes beside it as PNG")],
    series: Annotated[Path | None, typer.Option(help="CSV of grey and luminance, or of grey, red, green, blue")] = None,
    typed: Annotated[bool, typer.Option("--typed", help="ask for the luminances, one after the other")] = False,
    levels: Annotated[int, typer.Option(help="grey levels asked for with --typed", min=4, max=64)] = 9,
    photos: Annotated[Path | None, typer.Option(help="folder of photographs of --panel's `grey-chart`")] = None,
    panel: Annotated[
        int, typer.Option(help="with --photos: whose chart; with --typed: show the greys on it, -1: on none")
    ] = -1,
    config: ConfigOption = None,
    as_json: JsonOption = False,
) -> None:
    """Fit one panel's grey curve, the other panels at zero, and invert it to its LUT.

    From a photometer's series, or from photographs of the panel's `grey-chart` with any camera: exposure locked, the
    room dark, the whole chart in the picture, nothing cut off. Two or three from different places are better than one.

    Example: phasestack calibrate panels grey --series photometer.csv --out panel-2.csv
    """
    from calib.grey_run import fit_lut

    if (series is not None) + typed + (photos is not None) != 1:
        raise InputError("calibrate panels grey", "--series", "or --photos or --typed is needed, one of them")
    settings, stack = settings_and_stack(config)
    if not -1 <= panel < stack.count:
        raise InputError("calibrate panels grey", "--panel", f"must be -1 to {stack.count - 1}")
    if photos is not None and panel < 0:
        raise InputError("calibrate panels grey", "--panel", "is needed: whose chart the photographs show")
    summary, text = fit_lut(out, series, settings=settings, stack=stack, levels=levels, panel=panel, photos=photos)
    tell(summary, as_json, text)


@app.command("grey-chart")
def grey_chart_command(
    panel: Annotated[int, typer.Option(help="the panel that shows it; the others are clear", min=0)],
    out: Annotated[Path | None, typer.Option(help="write it as this PNG")] = None,
    show: Annotated[bool, typer.Option("--show", help="show it on the panel until Enter or q")] = False,
    panels: PanelsOption = None,
    config: ConfigOption = None,
) -> None:
    """Draw or show a panel's chart of greys, of which `grey --photos` wants photographs.

    Example: phasestack calibrate panels grey-chart --panel 2 --config phasestack.toml --show
    """
    if out is None and not show:
        raise InputError("calibrate panels grey-chart", "--out", "is missing (or give --show)")
    from calib.grey_chart import grey_chart
    from calib.grey_run import show_grey_chart
    from runtime.support.artifacts import write_png

    settings, stack = settings_and_stack(config, panels)
    if panel >= stack.count:
        raise InputError("calibrate panels grey-chart", "--panel", f"must be 0 to {stack.count - 1}")
    if out is not None:
        write_png(out, grey_chart(stack, panel))
        typer.echo(f"{out}")
    if show:
        show_grey_chart(settings, stack, panel=panel)


@app.command()
def cost(
    out: Annotated[Path, typer.Option(help="folder for cost.json, cost.png, index.html")],
    model: Annotated[str, typer.Option(help="model whose layers are displaced")] = "best",
    left: Annotated[Path | None, typer.Option(help="the left eye's picture; without: the configured scene")] = None,
    right: Annotated[Path | None, typer.Option(help="the right eye's picture")] = None,
    left_eye: Annotated[Point, place(help="the left eye, metres before the stack")] = LEFT_EYE,
    right_eye: Annotated[Point, place(help="the right eye, metres")] = RIGHT_EYE,
    panels: PanelsOption = None,
    config: ConfigOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show what registration error costs: displayed dB against the displacement of each panel.

    Example: phasestack calibrate panels cost --out cost
    """
    from calib.cost_run import measure_cost

    if (left is None) != (right is None):
        raise InputError("calibrate panels cost", "--left", "and --right go together")
    settings, stack = settings_and_stack(config, panels)
    eyes = (_eye(left_eye, stack, "--left-eye"), _eye(right_eye, stack, "--right-eye"))
    pictures = None if left is None or right is None else (left, right)
    summary, text = measure_cost(out, settings, stack, eyes_m=eyes, pictures=pictures, model=model)
    tell(summary, as_json, text)


@app.command()
def simulate(
    out: Annotated[Path, typer.Option(help="folder for simulation.json, vernier.csv and the registration's report")],
    eye: EyeOption = EYE,
    seed: Annotated[int, typer.Option(min=0, help="of the misalignment and of the installer's hand")] = 0,
    noise_px: Annotated[float, number(0, 100, help="how exactly a half is set, standard deviation")] = 0.06,
    viewpoint_error_mm: Annotated[
        float, number(0, 1000, "mm", help="how far off the mark the eye is, standard deviation")
    ] = 0.0,
    model: Annotated[str, typer.Option(help="model whose layers are judged; empty: geometry only")] = "best",
    panels: PanelsOption = None,
    config: ConfigOption = None,
    as_json: JsonOption = False,
) -> None:
    """Misalign a simulated stack, set its verniers, register it: what is recovered, and what that gains in dB.

    Example: phasestack calibrate panels simulate --out simulation
    """
    from calib.cost_run import simulate_registration

    settings, stack = settings_and_stack(config, panels)
    summary, text = simulate_registration(
        out,
        settings,
        stack,
        eye_m=_eye(eye, stack),
        seed=seed,
        noise_px=noise_px,
        viewpoint_error_m=viewpoint_error_mm / 1000,
        model=model,
    )
    tell(summary, as_json, text)


def _eye(eye: Point, stack: PanelStack, option: str = "--eye") -> Point:
    if eye[0] <= max(stack.x_m):
        raise InputError("calibrate panels", option, "must be in front of every panel, in metres")
    return eye


def _reference(reference: int, stack: PanelStack) -> int:
    if not -1 <= reference < stack.count:
        raise InputError("calibrate panels", "--reference", f"must be -1 to {stack.count - 1}")
    return stack.count // 2 if reference == -1 else reference
