"""`phasestack ctl` and `status`: commands to the running daemon, and its state."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from runtime.support.options import number

app = typer.Typer(
    no_args_is_help=True,
    help="Tell the running daemon what to do between two of its turns. Exits with 1 where no daemon answers.\n\n"
    "Example: phasestack ctl scene demo",
)

Config = Annotated[Path | None, typer.Option(help="configuration of the daemon: says where its socket is")]


@app.command()
def scene(
    name: Annotated[str, typer.Argument(help="what `content.scene` takes; `next`: of the playlist that is shown")],
    config: Config = None,
) -> None:
    """Show another scene: a built-in one, such as `demo`, or a file or folder (`./NAME`) of this machine.

    The present scene goes on while it is loaded, and stays where it can't be: then this exits with 2 and one line.

    Example: phasestack ctl scene demo
    """
    from runtime.support.plugins import located

    request = {"command": "next"} if name == "next" else {"command": "scene", "value": located(name, Path.cwd())}
    tell(request, config)


@app.command()
def place(
    scale: Annotated[float | None, number(0.001, 1000, help="scale factor of the scene")] = None,
    offset: Annotated[
        tuple[float, float, float] | None, number(-10, 10, "m", help="where it is moved: out, right, up; metres")
    ] = None,
    rotate: Annotated[
        tuple[float, float, float] | None,
        number(-360, 360, "degrees", help="turns about the axes out, right and up; degrees"),
    ] = None,
    turntable: Annotated[
        float | None, number(-600, 600, help="turns a minute about the vertical; 0: it stands")
    ] = None,
    reset: Annotated[bool, typer.Option("--reset", help="as the configuration has it")] = False,
    config: Config = None,
) -> None:
    """Move, turn or scale the scene that is shown, at once. What is not named stays as it is.

    Another scene stands as the configuration has it again.

    Example: phasestack ctl place --scale 1.2 --offset 0.01 0 -0.02 --turntable 3
    """
    from runtime.errors import InputError

    given = {"scale": scale, "offset_m": offset, "rotation_deg": rotate, "turntable_per_min": turntable}
    value = {name: asked for name, asked in given.items() if asked is not None}
    if reset == bool(value):
        raise InputError("ctl place", "", "give --reset alone, or what is to change: --scale, --offset, --rotate, ...")
    tell({"command": "place", "value": None if reset else value}, config)


@app.command()
def model(
    name: Annotated[str, typer.Argument(help="fast, balanced, best, sart or an ONNX file")],
    config: Config = None,
) -> None:
    """Solve with another model; the present one goes on while it is loaded, and stays where it can't be.

    Example: phasestack ctl model best
    """
    from runtime.support.plugins import located

    tell({"command": "model", "value": located(name, Path.cwd())}, config)


PLAIN = {
    "pause": "Freeze the picture as it is, until `resume`.",
    "resume": "Follow the viewer again, after `pause` or `flat`.",
    "flat": "Show the flat (2D) picture whoever looks, until `resume`.",
    "reload": "Read the configuration again; a bad one is refused and the old one stays.\n\n"
    "Scene, model and place that `ctl` chose stay, but where the file says something new of them.",
    "blackbox": "Write the last minutes to a file (MCAP), and print its name: eyes, states, times, log.",
}  # commands that take nothing but where the daemon is


def _add_plain(name: str, meaning: str) -> None:
    @app.command(name, help=f"{meaning}\n\nExample: phasestack ctl {name}")
    def plain(config: Config = None) -> None:
        tell({"command": name}, config)


for _name, _meaning in PLAIN.items():
    _add_plain(_name, _meaning)


def tell(request: dict[str, Any], config: Path | None) -> None:
    """Send one request; prints what holds now. Exits with 1 where no daemon answers, 2 where it refuses."""
    from runtime.daemon.client import TOLD_WITHIN_S, NotRunning, ask, sockets, unit_advice
    from runtime.errors import InputError
    from runtime.support.figures import lines_of

    try:
        answer = ask(sockets(config), request, timeout_s=TOLD_WITHIN_S)
    except NotRunning as error:
        typer.echo("; ".join(filter(None, (str(error), unit_advice()))), err=True)
        raise typer.Exit(1) from None
    if not answer.get("ok"):
        raise InputError(f"ctl {request['command']}", "", str(answer.get("error", "refused")))
    answer.pop("ok")
    typer.echo(answer.get("note") or answer.get("file") or "\n".join(lines_of(answer)))


def status(
    config: Config = None,
    as_json: Annotated[bool, typer.Option("--json", help="one JSON object on stdout")] = False,
) -> None:
    """Ask the running daemon: its state and why, rates now, eyes and how sure they are, times, faults.

    Exits with 1 where no daemon answers, or its loop has stood still for five seconds.

    Example: phasestack status --json
    """
    from runtime.daemon.client import HUNG_AFTER_S, NotRunning, ask, sockets, unit_advice
    from runtime.support.figures import shown

    try:
        answer = ask(sockets(config), {"command": "status"})
    except NotRunning as error:
        problem = "; ".join(filter(None, (str(error), unit_advice())))
        typer.echo(json.dumps({"ok": False, "error": problem}) if as_json else problem, err=not as_json)
        raise typer.Exit(1) from None
    typer.echo(shown(answer, as_json=as_json))
    if float(answer.get("turn_age_s", 0.0)) > HUNG_AFTER_S:
        typer.echo(f"the loop has not completed a turn for {answer['turn_age_s']:.0f} s", err=True)
        raise typer.Exit(1)
