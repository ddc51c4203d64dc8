"""`phasestack calibrate panels`: where the panels really are, and how grey they are. Nothing heavy at the top."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from runtime.errors import InputError

app = typer.Typer(
    no_args_is_help=True,
    help="Register the panels with each other and measure their grey curves.\n\n"
    "Example: phasestack calibrate panels vernier --config config.toml --eye 0.5 0 0 --out vernier.csv, "
    "then phasestack calibrate panels fit --vernier vernier.csv --config config.toml --write --out registration",
)

ConfigOption = Annotated[Path | None, typer.Option(help="configuration TOML; without it the defaults hold")]
PanelsOption = Annotated[Path | None, typer.Option(help="panel geometry, TOML or JSON; else the configuration's")]
EyeOption = Annotated[
    tuple[float, float, float], typer.Option(help="the marked viewpoint: one eye, X Y Z in metres before the stack")
]
ReferenceOption = Annotated[int, typer.Option(help="the panel that the others are registered to; -1: the middle one")]
JsonOption = Annotated[bool, typer.Option("--json", help="one JSON object on stdout")]
EYE = (0.5, 0.0, 0.0)


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

    _, stack = _settings_and_stack(config, panels)
    summary = write_vernier_charts(out, stack, eye_m=_eye(eye, stack), reference=_reference(reference, stack))
    _say(summary, as_json, f"{len(summary['files'])} files in {out}")


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

    Example: phasestack calibrate panels vernier --config config.toml --eye 0.5 0 0 --out vernier.csv
    """
    from calib.panel_run import nudge_verniers

    settings, stack = _settings_and_stack(config, panels)
    summary = nudge_verniers(out, settings, stack, eye_m=_eye(eye, stack), reference=_reference(reference, stack))
    _say(summary, as_json, f"{summary['settings']} of {summary['asked']} settings in {out}")


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

    Example: phasestack calibrate panels fit --vernier vernier.csv --config config.toml --write --out registration
    """
    from calib.panel_run import fit_registration

    if write and config is None:
        raise InputError("calibrate panels fit", "--write", "needs --config")
    settings, stack = _settings_and_stack(config, panels)
    summary, text = fit_registration(
        vernier, out, settings, stack, reference=_reference(reference, stack), config=config if write else None
    )
    _say(summary, as_json, text)


@app.command()
def grey(
    out: Annotated[Path, typer.Option(help="the panel's LUT, CSV; its plot goes beside it as PNG")],
    series: Annotated[Path | None, typer.Option(help="CSV of grey and luminance, or of grey, red, green, blue")] = None,
    typed: Annotated[bool, typer.Option("--typed", help="ask for the luminances, one after the other")] = False,
    levels: Annotated[int, typer.Option(help="grey levels asked for with --typed", min=4, max=64)] = 9,
    panel: Annotated[int, typer.Option(help="with --typed: show the greys on this panel; -1: on none")] = -1,
    config: ConfigOption = None,
    as_json: JsonOption = False,
) -> None:
    """Fit one panel's grey curve, the other panels at zero, and invert it to its LUT.

    Example: phasestack calibrate panels grey --series photometer.csv --out panel-2.csv
    """
    from calib.grey_run import fit_lut

    if (series is None) == (not typed):
        raise InputError("calibrate panels grey", "--series", "or --typed is needed, one of them")
    settings, stack = _settings_and_stack(config, None)
    if not -1 <= panel < stack.count:
        raise InputError("calibrate panels grey", "--panel", f"must be -1 to {stack.count - 1}")
    summary, text = fit_lut(out, series, settings=settings, stack=stack, levels=levels, panel=panel)
    _say(summary, as_json, text)


@app.command()
def cost(
    out: Annotated[Path, typer.Option(help="folder for cost.json, cost.png, index.html")],
    model: Annotated[str, typer.Option(help="model whose layers are displaced")] = "best",
    left: Annotated[Path | None, typer.Option(help="the left eye's picture; without: the configured scene")] = None,
    right: Annotated[Path | None, typer.Option(help="the right eye's picture")] = None,
    left_eye: EyeOption = (0.6, -0.03, 0.0),
    right_eye: EyeOption = (0.6, 0.03, 0.0),
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
    settings, stack = _settings_and_stack(config, panels)
    eyes = (_eye(left_eye, stack), _eye(right_eye, stack))
    pictures = None if left is None or right is None else (left, right)
    summary, text = measure_cost(out, settings, stack, eyes_m=eyes, pictures=pictures, model=model)
    _say(summary, as_json, text)


@app.command()
def simulate(
    out: Annotated[Path, typer.Option(help="folder for simulation.json, vernier.csv and the registration's report")],
    eye: EyeOption = EYE,
    seed: Annotated[int, typer.Option(help="of the misalignment and of the installer's hand")] = 0,
    noise_px: Annotated[float, typer.Option(help="how exactly a half is set, standard deviation")] = 0.06,
    viewpoint_error_mm: Annotated[float, typer.Option(help="how far off the mark the eye is, standard deviation")] = (
        0.0
    ),
    model: Annotated[str, typer.Option(help="model whose layers are judged; empty: geometry only")] = "best",
    panels: PanelsOption = None,
    config: ConfigOption = None,
    as_json: JsonOption = False,
) -> None:
    """Misalign a simulated stack, set its verniers, register it: what is recovered, and what that gains in dB.

    Example: phasestack calibrate panels simulate --out simulation
    """
    from calib.cost_run import simulate_registration

    if noise_px < 0 or viewpoint_error_mm < 0:
        raise InputError("calibrate panels simulate", "--noise-px", "and --viewpoint-error-mm must not be negative")
    settings, stack = _settings_and_stack(config, panels)
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
    _say(summary, as_json, text)


def _settings_and_stack(config: Path | None, panels: Path | None) -> tuple[Any, Any]:
    from runtime.config import load_settings, load_stack

    settings = load_settings(config)
    geometry = settings.stack
    if panels is None:
        return settings, geometry.stack()
    return settings, load_stack(panels, width_px=geometry.width_px, height_px=geometry.height_px)


def _eye(eye: tuple[float, float, float], stack: Any) -> tuple[float, float, float]:
    if not all(abs(value) < 100 for value in eye) or eye[0] <= max(stack.x_m):
        raise InputError("calibrate panels", "--eye", "must be in front of every panel, in metres")
    return eye


def _reference(reference: int, stack: Any) -> int:
    if not -1 <= reference < stack.count:
        raise InputError("calibrate panels", "--reference", f"must be -1 to {stack.count - 1}")
    return int(stack.count // 2 if reference == -1 else reference)


def _say(summary: dict[str, Any], as_json: bool, text: str) -> None:
    if not as_json:
        typer.echo(text)
        return
    from runtime.artifacts import to_json

    typer.echo(json.dumps(json.loads(to_json(summary))))
