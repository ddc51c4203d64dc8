"""`phasestack ctl`: tells the running daemon what to do between two of its turns."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

app = typer.Typer(
    no_args_is_help=True,
    help="Tell the running daemon what to do between two of its turns. Exits with 1 where no daemon answers.\n\n"
    "Example: phasestack ctl scene lego_bulldozer",
)

ANSWERS_WITHIN_S = 70.0  # a scene or a model is loaded first: longer than the daemon itself waits for that

Config = Annotated[Path | None, typer.Option(help="configuration of the daemon: says where its socket is")]
Socket = Annotated[Path | None, typer.Option(help="the socket itself, whatever the configuration says")]


@app.command()
def scene(
    name: Annotated[str, typer.Argument(help="what `content.scene` of the configuration takes")],
    config: Config = None,
    socket: Socket = None,
) -> None:
    """Show another scene: a preset's name, `demo`, or a file or folder of this machine, seen from here.

    The present scene goes on while it is loaded, and stays where it can't be: then this exits with 2 and one line.

    Example: phasestack ctl scene demo
    """
    from runtime.daemon.names import scene_from_here

    tell({"command": "scene", "value": scene_from_here(name)}, config, socket)


@app.command()
def pause(config: Config = None, socket: Socket = None) -> None:
    """Freeze the picture as it is, until `resume`.

    Example: phasestack ctl pause
    """
    tell({"command": "pause"}, config, socket)


@app.command()
def resume(config: Config = None, socket: Socket = None) -> None:
    """Follow the viewer again, after `pause` or `flat`.

    Example: phasestack ctl resume
    """
    tell({"command": "resume"}, config, socket)


@app.command()
def flat(config: Config = None, socket: Socket = None) -> None:
    """Show the flat (2D) picture whoever looks, until `resume`.

    Example: phasestack ctl flat
    """
    tell({"command": "flat"}, config, socket)


@app.command()
def budget(
    milliseconds: Annotated[float, typer.Argument(help="time for one frame; 0: none")],
    config: Config = None,
    socket: Socket = None,
) -> None:
    """Set the time for one frame: model and resolution are chosen to fit.

    Example: phasestack ctl budget 16
    """
    tell({"command": "budget", "value": milliseconds}, config, socket)


@app.command()
def reload(config: Config = None, socket: Socket = None) -> None:
    """Read the configuration again; a bad one is refused and the old one stays.

    Example: phasestack ctl reload
    """
    tell({"command": "reload"}, config, socket)


@app.command()
def blackbox(config: Config = None, socket: Socket = None) -> None:
    """Write the last minutes to a file (MCAP), and print its name: eyes, states, times, pictures, log.

    Example: phasestack ctl blackbox
    """
    typer.echo(tell({"command": "blackbox"}, config, socket).get("file", ""))


def tell(request: dict[str, Any], config: Path | None, socket: Path | None) -> dict[str, Any]:
    """Send one request; the daemon's answer. Exits with 1 where no daemon answers, 2 where it refuses."""
    from runtime.commands.status import sockets
    from runtime.daemon.client import NotRunning, ask
    from runtime.errors import InputError

    try:
        answer = ask(sockets(config, socket), request, timeout_s=ANSWERS_WITHIN_S)
    except NotRunning as error:
        typer.echo(str(error), err=True)
        raise typer.Exit(1) from None
    if not answer.get("ok"):
        raise InputError(f"ctl {request['command']}", "", str(answer.get("error", "refused")))
    if answer.get("note"):
        typer.echo(answer["note"], err=True)
    return answer
