"""`phasestack ctl` and `phasestack status`: control the running daemon, and show its state."""

from __future__ import annotations

import json
from contextvars import ContextVar
from pathlib import Path
from typing import Annotated, Any

import typer

from runtime.support.options import number

app = typer.Typer(
    no_args_is_help=True,
    help="Control the running daemon. Exits with 1 if no daemon answers.\n\nExample: phasestack ctl scene demo",
)

Triple = tuple[float, float, float]
Config = Annotated[Path | None, typer.Option(help="configuration file that names the daemon's socket")]
_given_before: ContextVar[Path | None] = ContextVar("config", default=None)  # `--config` before the subcommand


@app.callback()
def before_the_subcommand(config: Config = None) -> None:
    """Keep an option that stands before the subcommand: `ctl --config FILE pause`."""
    _given_before.set(config)


@app.command()
def scene(
    name: Annotated[str, typer.Argument(help="scene to show, or `next` for the playlist's next entry")],
    config: Config = None,
) -> None:
    """Show another scene: a built-in one such as `demo`, or a file or folder on this PC (`./NAME`).

    The current scene stays until the new one has loaded. If loading fails, the scene is not changed and the exit code
    is 2.

    Example: phasestack ctl scene demo
    """
    from runtime.support.plugins import located

    request = {"command": "next"} if name == "next" else {"command": "scene", "value": located(name, Path.cwd())}
    tell(request, config)


@app.command()
def place(
    scale: Annotated[float | None, number(0.001, 1000, help="factor by which to scale the scene")] = None,
    offset: Annotated[
        Triple | None, number(-10, 10, "m", help="offset in metres (out of the screen, right, up)")
    ] = None,
    rotate: Annotated[Triple | None, number(-360, 360, "degrees", help="rotation in degrees about these axes")] = None,
    turntable: Annotated[float | None, number(-600, 600, help="turns per minute about the vertical axis")] = None,
    convergence: Annotated[float | None, number(-0.1, 0.1, "m", help="metres from the left to the right view")] = None,
    comfort: Annotated[float | None, number(0, 10, "degrees", help="limit for the depth of stereo pictures")] = None,
    reset: Annotated[bool, typer.Option("--reset", help="restore the configured placement")] = False,
    config: Config = None,
) -> None:
    """Move, turn or scale the current scene.

    If an option is omitted, its value stays the same. The next scene starts with the configured placement.

    Example: phasestack ctl place --scale 1.2 --offset 0.01 0 -0.02 --turntable 3
    """
    from runtime.errors import InputError

    options = {"scale": scale, "offset_m": offset, "rotation_deg": rotate, "turntable_per_min": turntable}
    options |= {"convergence_m": convergence, "comfort_deg": comfort}
    value = {name: option for name, option in options.items() if option is not None}
    if reset == bool(value):
        raise InputError("ctl place", "", "pass either --reset, or at least one other option, such as --scale")
    tell({"command": "place", "value": None if reset else value}, config)


@app.command()
def model(
    name: Annotated[str, typer.Argument(help="model to use: fast, balanced, best, sart or an ONNX file")],
    config: Config = None,
) -> None:
    """Switch to another model.

    The current model is used until the new one has loaded, and stays in use if loading fails.

    Example: phasestack ctl model best
    """
    from runtime.support.plugins import located

    tell({"command": "model", "value": located(name, Path.cwd())}, config)


PLAIN = {
    "pause": "Freeze the picture until `resume`.",
    "resume": "Follow the viewer again, after `pause` or `flat`.",
    "flat": "Show the flat (2D) picture until `resume`.",
    "reload": "Reload the configuration file. If it is invalid, the old configuration stays in use.\n\n"
    "A scene, model or placement set by `ctl` stays unless the file has changed that setting.",
    "blackbox": "Save the last minutes of eyes, states, times and log lines to an MCAP file and print its name.\n\n"
    "The setting `service.blackbox_minutes` is the number of minutes.",
}  # commands that take no argument


def _add_plain(name: str, meaning: str) -> None:
    @app.command(name, help=f"{meaning}\n\nExample: phasestack ctl {name}")
    def plain(config: Config = None) -> None:
        tell({"command": name}, config)


for _name, _meaning in PLAIN.items():
    _add_plain(_name, _meaning)


def tell(request: dict[str, Any], config: Path | None) -> None:
    """Send a request and print the new state. Exits with 1 without a daemon. Raises InputError."""
    from runtime.daemon.client import ANSWERED_WITHIN_S, NotRunning, ask, sockets
    from runtime.errors import InputError
    from runtime.support.figures import lines_of

    config = config or _given_before.get()
    try:
        answer = ask(sockets(config), request, timeout_s=ANSWERED_WITHIN_S)
    except NotRunning as error:
        typer.echo(_advised(error), err=True)
        raise typer.Exit(1) from None
    if not answer.get("ok"):
        raise InputError(f"ctl {request['command']}", "", str(answer.get("error", "refused")))
    answer.pop("ok")
    typer.echo(answer.get("note") or answer.get("file") or "\n".join(lines_of(answer)))


def _advised(error: Exception) -> str:
    """Return the message for a request that was not answered, including advice for the user."""
    from runtime.daemon.client import unit_advice

    advice = unit_advice()
    if not advice and any(each in str(error) for each in ("no daemon", "has died")):
        advice = "start one with `phasestack run`, or use `phasestack try` if there is no hardware"
    return "; ".join(filter(None, (str(error), advice)))


def status(
    config: Config = None,
    as_json: Annotated[bool, typer.Option("--json", help="print the status as a JSON object")] = False,
) -> None:
    """Show the daemon's state and its reason, the scene, rates, quality and faults; then all figures.

    Exits with 1 if no daemon answers, or if its loop has been hanging for five seconds.

    Example: phasestack status --json
    """
    from runtime.commands.status_text import status_lines
    from runtime.daemon.client import HUNG_AFTER_S, NotRunning, ask, sockets

    try:
        answer = ask(sockets(config), {"command": "status"})
    except NotRunning as error:
        problem = _advised(error)
        typer.echo(json.dumps({"ok": False, "error": problem}) if as_json else problem, err=not as_json)
        raise typer.Exit(1) from None
    typer.echo(json.dumps(answer) if as_json else "\n".join(status_lines(answer)))
    if float(answer.get("turn_age_s", 0.0)) > HUNG_AFTER_S:
        typer.echo(
            f"the display loop has not responded for {answer['turn_age_s']:.0f} s; see journalctl -u phasestack",
            err=True,
        )
        raise typer.Exit(1)
