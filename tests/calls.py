"""Calls of commands and functions in a test, with what they answer and how they refuse."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest
import typer
from typer.testing import CliRunner, Result

from runtime.errors import InputError


def invoked(command: Callable[..., Any], *arguments: object) -> Result:
    """Result of a command (a function, or an app of several commands) with these arguments."""
    app = command
    if not isinstance(app, typer.Typer):
        app = typer.Typer()
        app.command()(command)
    return CliRunner().invoke(app, list(map(str, arguments)))


def answered(command: Callable[..., Any], *arguments: object) -> Any:
    """What a command prints with --json. Raises what the command raised, even an exit status other than 0."""
    result = invoked(command, *arguments, "--json")
    if result.exception is not None:
        raise result.exception
    return json.loads(result.stdout)


def refusal(call: Callable[..., Any], *arguments: Any, **named: Any) -> str:
    """The one printable line of the InputError with which a call is refused."""
    with pytest.raises(InputError) as caught:
        call(*arguments, **named)
    line = str(caught.value)
    assert line.isprintable() and len(line) < 1000, line
    return line
