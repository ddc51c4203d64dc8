"""`phasestack status`: what the running daemon does, and why."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from collections.abc import Iterator

HUNG_AFTER_S = 5.0


def status(
    config: Annotated[Path | None, typer.Option(help="configuration of the daemon: says where its socket is")] = None,
    socket: Annotated[Path | None, typer.Option(help="the socket itself, whatever the configuration says")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="one JSON object on stdout")] = False,
) -> None:
    """Ask the running daemon: its state and why, rate, stage times, eyes, faults.

    Exits with 1 where no daemon answers, or its loop has stood still for five seconds.

    Example: phasestack status --json
    """
    from runtime.daemon.client import NotRunning, ask

    try:
        answer = ask(sockets(config, socket), {"command": "status"})
    except NotRunning as error:
        typer.echo(json.dumps({"ok": False, "error": str(error)}) if as_json else str(error), err=not as_json)
        raise typer.Exit(1) from None
    if as_json:
        typer.echo(json.dumps(answer))
    else:
        for line in describe(answer):
            typer.echo(line)
    if float(answer.get("turn_age_s", 0.0)) > HUNG_AFTER_S:
        typer.echo(f"the loop has not completed a turn for {answer['turn_age_s']:.0f} s", err=True)
        raise typer.Exit(1)


def sockets(config: Path | None, socket: Path | None) -> tuple[Path, ...]:
    """Where the daemon may listen: the one given, or the configured one and the person's own."""
    if socket is not None:
        return (socket,)
    from runtime.config import load_settings
    from runtime.daemon.location import candidates

    return candidates(load_settings(config).service.socket)


def describe(answer: dict[str, Any]) -> Iterator[str]:
    """The answer as lines for people; what the daemon did not say is left out."""
    yield row("state", answer.get("state", "unknown"), answer.get("reason", ""))
    for part, why in dict(answer.get("missing") or {}).items():
        yield row(f"  missing {part}", why)
    yield row("up", duration(float(answer.get("uptime_s", 0.0))), f"pid {answer.get('pid', '?')}")
    frames = [f"{answer[name]} {name}" for name in ("frames", "presented", "dropped", "stale_inputs") if name in answer]
    if "fps" in answer:
        yield row("rate", f"{float(answer['fps']):.1f} frames/s", ", ".join(frames))
    for name in ("scene", "loading", "refused", "model", "provider", "panels"):
        if answer.get(name):
            yield row(name, str(answer[name]))
    if answer.get("eyes_m"):
        left, right = answer["eyes_m"]
        text = "  ".join(f"({x:.3f}, {y:.3f}, {z:.3f})" for x, y, z in (left, right))
        yield row("eyes", f"{text} m", str(answer.get("eyes_label", "")))
    for name, unit in (("overhead_ms", "ms"), ("skew_ms", "ms"), ("stage_ms", "ms")):
        if answer.get(name) is not None:
            yield row(name.removesuffix("_ms"), timings(answer[name], unit))
    for part, count in dict(answer.get("faults") or {}).items():
        yield row(f"faults {part}", str(count))
    if budget := answer.get("budget"):
        held = {True: "held", False: "not held"}.get(budget.get("held"), "")
        remark = ", ".join(
            text for text in (held, budget.get("measuring") and f"measuring {budget['measuring']}") if text
        )
        yield row("budget", f"{budget['budget_ms']:g} ms: {budget['level']}", remark)
    for item in answer.get("plan") or ():
        yield row("left out", str(item.get("what", "")), str(item.get("why", "")))


def row(name: str, value: str, remark: str = "") -> str:
    """One aligned line."""
    return f"{name:16} {value}" + (f"  ({remark})" if remark else "")


def timings(value: Any, unit: str) -> str:
    """A number, or quantiles, or quantiles per stage, on one line."""
    if isinstance(value, dict):
        if all(isinstance(part, dict) for part in value.values()):
            return ", ".join(f"{name} {part.get('p50', 0.0):.2f}" for name, part in value.items()) + f" {unit} (median)"
        return ", ".join(f"{name} {float(part):.2f}" for name, part in value.items()) + f" {unit}"
    return f"{float(value):.2f} {unit}"


def duration(seconds: float) -> str:
    """Hours, minutes and seconds, without leading zeros' noise."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02} min" if hours else f"{minutes} min {rest:02} s" if minutes else f"{rest} s"
