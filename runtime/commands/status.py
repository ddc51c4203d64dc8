"""`phasestack status`: what the running daemon does, and why."""

from __future__ import annotations

import json
from datetime import timedelta
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


STEERED = {
    "paused": "the picture is frozen until `phasestack ctl resume`",
    "flat_asked": "the flat picture, until `phasestack ctl resume`",
}
# Lines of figures: title, what the daemon calls it, how it is written. What was not measured is left out.
FIGURES = (
    ("now", "fps_now", "{:.1f} refreshes/s"),
    ("now", "solutions_per_s_now", "{:.1f} solutions/s"),
    ("rate", "fps", "{:.1f} frames/s"),
    ("refreshes", "frames", "{}"),
    ("refreshes", "presented", "{} presented"),
    ("refreshes", "dropped", "{} dropped"),
    ("refreshes", "missed_blanks", "{} blanks missed"),
    ("solution", "solution_age_now_ms", "{:.0f} ms old at its light"),
    ("sensor", "sensor_hz", "{:.1f} samples/s"),
    ("sensor", "stale_inputs", "{} skipped"),
    ("log", "log_lines_lost", "{} lines were lost: they could not be written"),
)
NAMED = ("scene", "content", "content_problem", "loading", "refused", "model", "provider", "panels")
TIMES = {
    "photon_ms": "capture to light",
    "solution_age_ms": "solution's age",
    "interval_ms": "between frames",
    "overhead_ms": "overhead",
    "skew_ms": "skew",
    "stage_ms": "stage",
}


def describe(answer: dict[str, Any]) -> Iterator[str]:
    """The answer as lines for people; what the daemon did not say, or did not measure, is left out."""
    yield row("state", answer.get("state", "unknown"), answer.get("reason", ""))
    for part, why in dict(answer.get("missing") or {}).items():
        yield row(f"  missing {part}", why)
    for name, meaning in STEERED.items():
        if answer.get(name):
            yield row(name.partition("_")[0], meaning)
    if "uptime_s" in answer:
        yield row("up", str(timedelta(seconds=round(float(answer["uptime_s"])))), f"pid {answer.get('pid', '?')}")
    figures: dict[str, list[str]] = {}
    for title, name, form in FIGURES:
        if answer.get(name) is not None and (answer[name] or title != "log"):
            figures.setdefault(title, []).append(form.format(answer[name]))
    for title, said in figures.items():
        yield row(title, ", ".join(said))
    for name in NAMED:
        if answer.get(name) and (name != "content" or answer["content"] != answer.get("scene")):
            yield row(name, str(answer[name]))
    if answer.get("eyes_m"):
        places = "  ".join(f"({x:.3f}, {y:.3f}, {z:.3f})" for x, y, z in answer["eyes_m"])
        sigma_mm = answer.get("eye_sigma_now_mm")
        sure = "" if sigma_mm is None else f", to {float(sigma_mm):.2f} mm (one standard deviation)"
        yield row("eyes", f"{places} m", f"{answer.get('eyes_label', '')}{sure}")
    refused = [f"{count} {why}" for why, count in dict(answer.get("rejected_samples") or {}).items() if count]
    if refused:
        yield row("rejected", ", ".join(refused), "samples")
    for name, title in TIMES.items():
        if text := timings(answer.get(name)):
            yield row(title, text)
    for part, count in dict(answer.get("faults") or {}).items():
        yield row(f"faults {part}", str(count))
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


def row(name: str, value: str, remark: str = "") -> str:
    """One aligned line; what came through the socket can't break it."""
    return one_line(f"{name:16} {value}" + (f"  ({remark})" if remark else ""), most=2000)


def timings(value: Any) -> str:
    """A number, or quantiles, or the medians of stages, on one line; empty where nothing was measured."""
    if value is None:
        return ""
    if not isinstance(value, dict):
        return f"{float(value):.2f} ms"
    medians = {name: part.get("p50") if isinstance(part, dict) else part for name, part in value.items()}
    known = [f"{name} {float(part):.2f}" for name, part in medians.items() if part is not None]
    return ", ".join(known) + " ms" if known else ""
