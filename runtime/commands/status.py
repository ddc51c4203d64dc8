"""`phasestack status`: what the running daemon does, and why."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from runtime.errors import one_line

if TYPE_CHECKING:
    from collections.abc import Iterator

HUNG_AFTER_S = 5.0


def status(
    config: Annotated[Path | None, typer.Option(help="configuration of the daemon: says where its socket is")] = None,
    socket: Annotated[Path | None, typer.Option(help="the socket itself, whatever the configuration says")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="one JSON object on stdout")] = False,
) -> None:
    """Ask the running daemon: its state and why, rates now, eyes and how sure they are, times, faults.

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
    from runtime.daemon.client import candidates, configured_socket

    return candidates(configured_socket(config))


def describe(answer: dict[str, Any]) -> Iterator[str]:
    """The answer as lines for people; what the daemon did not say, or did not measure, is left out."""
    yield row("state", answer.get("state", "unknown"), answer.get("reason", ""))
    for part, why in dict(answer.get("missing") or {}).items():
        yield row(f"  missing {part}", why)
    if answer.get("paused"):
        yield row("paused", "the picture is frozen until `phasestack ctl resume`")
    if answer.get("flat_asked"):
        yield row("flat", "asked for, until `phasestack ctl resume`")
    if "uptime_s" in answer:
        yield row("up", duration(float(answer["uptime_s"])), f"pid {answer.get('pid', '?')}")
    yield from rates(answer)
    for name in ("scene", "content", "content_problem", "loading", "refused", "model", "provider", "panels"):
        if answer.get(name) and (name != "content" or answer["content"] != answer.get("scene")):
            yield row(name, str(answer[name]))
    yield from eyes(answer)
    for name in ("photon_ms", "solution_age_ms", "interval_ms", "overhead_ms", "skew_ms", "stage_ms"):
        if text := timings(answer.get(name), "ms"):
            yield row(TOLD_AS.get(name, name.removesuffix("_ms")), text)
    for part, count in dict(answer.get("faults") or {}).items():
        yield row(f"faults {part}", str(count))
    if answer.get("log_lines_lost"):
        yield row("log", f"{answer['log_lines_lost']} lines were lost: they could not be written")
    for item in answer.get("plan") or ():
        yield row("left out", str(item.get("what", "")), str(item.get("why", "")))


def holds(answer: dict[str, Any]) -> str:
    """What an operator chooses, as it is now, on one line."""
    placing = answer.get("placing") or {}
    moved = [f"{name.partition('_')[0]} {value}" for name, value in placing.items() if value != UNMOVED.get(name)]
    scene, content = str(answer.get("scene", "")), str(answer.get("content", ""))
    parts = [
        f"scene {scene}" + (f" ({content})" if content not in ("", scene) else ""),
        f"model {answer.get('model', '')}",
        *moved,
        "paused" if answer.get("paused") else "",
        "flat" if answer.get("flat_asked") else "",
    ]
    return one_line(", ".join(filter(None, parts)), most=2000)


UNMOVED = {"scale": 1.0, "offset_m": [0.0] * 3, "rotation_deg": [0.0] * 3, "turntable_per_min": 0.0}
TOLD_AS = {"photon_ms": "capture to light", "solution_age_ms": "solution's age", "interval_ms": "between frames"}


def rates(answer: dict[str, Any]) -> Iterator[str]:
    """Refreshes and solutions a second, now and since the start."""
    now = [
        f"{float(answer[name]):.1f} {what}/s"
        for name, what in (("fps_now", "refreshes"), ("solutions_per_s_now", "solutions"))
        if answer.get(name) is not None
    ]
    if now:
        yield row("now", ", ".join(now))
    counts = [
        f"{answer[name]} {name.replace('_', ' ')}"
        for name in ("frames", "presented", "dropped", "missed_blanks", "stale_inputs")
        if answer.get(name) is not None
    ]
    if answer.get("fps") is not None:
        yield row("rate", f"{float(answer['fps']):.1f} frames/s", ", ".join(counts))
    elif counts:
        yield row("refreshes", ", ".join(counts))


def eyes(answer: dict[str, Any]) -> Iterator[str]:
    """Where they are, how that is known and how sure it is; what the sensor brings and what of it is refused."""
    if answer.get("eyes_m"):
        left, right = answer["eyes_m"]
        text = "  ".join(f"({x:.3f}, {y:.3f}, {z:.3f})" for x, y, z in (left, right))
        label, sigma_mm = str(answer.get("eyes_label", "")), answer.get("eye_sigma_now_mm")
        sure = "" if sigma_mm is None else f"to {float(sigma_mm):.2f} mm (one standard deviation)"
        yield row("eyes", f"{text} m", ", ".join(filter(None, (label, sure))))
    if answer.get("solution_age_now_ms") is not None:
        yield row("solution", f"{float(answer['solution_age_now_ms']):.0f} ms old at its light")
    if answer.get("sensor_hz") is not None:
        yield row("sensor", f"{float(answer['sensor_hz']):.1f} samples/s")
    refused = {why: count for why, count in dict(answer.get("rejected_samples") or {}).items() if count}
    if refused:
        yield row("rejected", ", ".join(f"{count} {why}" for why, count in refused.items()), "samples")


def row(name: str, value: str, remark: str = "") -> str:
    """One aligned line; what came through the socket can't break it."""
    return one_line(f"{name:16} {value}" + (f"  ({remark})" if remark else ""), most=2000)


def timings(value: Any, unit: str) -> str:
    """A number, or quantiles, or quantiles per stage, on one line; empty where nothing was measured."""
    if value is None:
        return ""
    if not isinstance(value, dict):
        return f"{float(value):.2f} {unit}"
    stages = {
        name: part["p50"] for name, part in value.items() if isinstance(part, dict) and part.get("p50") is not None
    }
    if stages:
        return ", ".join(f"{name} {p50:.2f}" for name, p50 in stages.items()) + f" {unit} (median)"
    plain = {name: part for name, part in value.items() if isinstance(part, (int, float))}
    return ", ".join(f"{name} {part:.2f}" for name, part in plain.items()) + f" {unit}" if plain else ""


def duration(seconds: float) -> str:
    """Hours, minutes and seconds, without leading zeros' noise."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02} min" if hours else f"{minutes} min {rest:02} s" if minutes else f"{rest} s"
