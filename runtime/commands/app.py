"""Typer app with all commands. Each command imports its dependencies only when it runs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

import typer

from calib.commands import app as calibrate_app
from model_export.commands import export, train, validate
from runtime.commands.bench import app as bench_app
from runtime.commands.config import config
from runtime.commands.ctl import app as ctl_app
from runtime.commands.ctl import status
from runtime.commands.demo import demo
from runtime.commands.doctor import doctor
from runtime.commands.eyes import eyes
from runtime.commands.identify import identify
from runtime.commands.page import page
from runtime.commands.plan import plan
from runtime.commands.record import record
from runtime.commands.report import report
from runtime.commands.run import run
from runtime.commands.setup import setup
from runtime.commands.solve import solve
from runtime.commands.stability import stability
from runtime.commands.tolerance import tolerance
from runtime.commands.try_ import try_

app = typer.Typer(
    name="phasestack",
    help="Realtime runtime of a glasses-free 3D display made of stacked LCD panels.\n\n"
    "Example: phasestack demo --out out/demo",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
COMMANDS: tuple[Callable[..., None] | tuple[str, typer.Typer | Callable[..., None]], ...] = (
    demo,
    ("try", try_),
    run,
    setup,
    solve,
    eyes,
    record,
    ("calibrate", calibrate_app),
    plan,
    train,
    export,
    validate,
    report,
    stability,
    tolerance,
    ("bench", bench_app),
    doctor,
    status,
    ("ctl", ctl_app),
    page,
    identify,
    config,
)
for command in COMMANDS:
    name, made = command if isinstance(command, tuple) else (None, command)
    if isinstance(made, typer.Typer):
        app.add_typer(made, name=name)
    else:
        app.command(name)(made)


def _print_version(wanted: bool) -> None:
    if wanted:
        from runtime.support.version import version

        typer.echo(f"phasestack {version()}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="print the version and exit")
    ] = False,
) -> None:
    """Accept options given before a command. `--help` shows the app's help, not this text."""
