"""Numeric options with ranges: a value out of range is refused by the option's name."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import typer

from runtime.errors import InputError
from runtime.support.ranges import EYE_MOST_M, refusal

OPTION_OF = {("content", "scene"): "scene", ("model", "name"): "model"}


def number(low: float, high: float, unit: str = "", *, help: str) -> Any:
    """An option whose number, or each of its numbers, lies from low to high, both finite.

    Anything else, NaN too, raises InputError when the line is read, naming command and option.
    """
    return typer.Option(help=f"{help} ({low:g} to {high:g})", callback=_checked(low, high, unit))


def place(*, help: str) -> Any:
    """An option that is where an eye is: three coordinates, metres, no farther than the settings allow."""
    return typer.Option(help=help, metavar="X Y Z", callback=_checked(-EYE_MOST_M, EYE_MOST_M, "m"))


@contextmanager
def blame_option(command: str, **given: Any) -> Iterator[None]:
    """An InputError about a setting, renamed to the command-line option that gave it."""
    try:
        yield
    except InputError as error:
        option = OPTION_OF.get((error.source, error.field))
        if option is None or given.get(option) is None:
            raise
        raise InputError(command, f"--{option}", error.problem) from None


def _checked(low: float, high: float, unit: str) -> Callable[[typer.Context, typer.CallbackParam, Any], Any]:
    def checked(context: typer.Context, parameter: typer.CallbackParam, value: Any) -> Any:
        for each in () if value is None else value if isinstance(value, tuple | list) else (value,):
            if problem := refusal(each, low, high, unit):
                own = context.command_path.removeprefix(context.find_root().command_path).strip()
                command = own or str(context.command.name)
                option = parameter.opts[0] if parameter.opts else str(parameter.name)
                raise InputError(command, option, problem)
        return value

    return checked
