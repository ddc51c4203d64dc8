"""Numeric command-line options with ranges, and errors that name the option."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from runtime.errors import InputError
from runtime.support.ranges import EYE_MOST_M, refusal

ConfigOption = Annotated[Path | None, typer.Option(help="configuration file (default: built-in settings)")]
JsonOption = Annotated[bool, typer.Option("--json", help="print the result as a JSON object")]
LayoutOption = Annotated[
    str | None,
    typer.Option(help="arrangement of the views in the pictures (same values as the content.layout setting)"),
]
ModelOption = Annotated[str | None, typer.Option(help="model to use: fast, balanced, best, sart or an ONNX file")]
OPTION_OF = {("content", "scene"): "scene", ("model", "name"): "model"}  # options, keyed by the setting they set


def number(low: float, high: float, unit: str = "", *, help: str) -> Any:
    """Return a typer option for finite numbers from `low` to `high`, a range that is added to the help.
    Parsing other numbers raises an InputError that names the command and the option. `unit` is for messages.
    """
    return typer.Option(help=f"{help} ({low:g} to {high:g})", callback=_checked(low, high, unit))


def place(*, help: str) -> Any:
    """Return a typer option for an eye position: three coordinates in metres, at most ±`EYE_MOST_M`."""
    return typer.Option(help=help, metavar="X Y Z", callback=_checked(-EYE_MOST_M, EYE_MOST_M, "m"))


@contextmanager
def blame_option(command: str, **options: Any) -> Iterator[None]:
    """Make any InputError raised in the block name the option that set the faulty setting. `options` are
    the values of those in OPTION_OF, None if not given.
    """
    try:
        yield
    except InputError as error:
        option = OPTION_OF.get((error.source, error.field))
        if option is None or options.get(option) is None:
            raise
        raise InputError(command, f"--{option}", error.problem) from None


def _checked(low: float, high: float, unit: str) -> Callable[[typer.Context, typer.CallbackParam, Any], Any]:
    def checked(context: typer.Context, parameter: typer.CallbackParam, value: Any) -> Any:
        for each in () if value is None else value if isinstance(value, tuple | list) else (value,):
            if problem := refusal(each, low, high, unit):
                path = context.command_path.removeprefix(context.find_root().command_path).strip()
                command = path or str(context.command.name)
                option = parameter.opts[0] if parameter.opts else str(parameter.name)
                raise InputError(command, option, problem)
        return value

    return checked
