"""Arrange the daemon's status as lines of text: what matters first, then groups."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from runtime.support.figures import effort_in_words, in_words, lines_of

# Fields by group, in the order shown. A field in none of them is shown in the last group.
GROUPS: Mapping[str, tuple[str, ...]] = {
    "scene": (
        "content", "content_problem", "content_left_out", "program", "playlist", "placing", "loading", "refused",
    ),
    "eyes": (
        "people", "people_in_view", "eyes_m", "eyes_label",
        "eye_sigma_now_mm", "eye_sigma_mm", "sensor_hz", "stale_inputs", "rejected_samples",
    ),
    "solver": (
        "model_asked", "provider", "backend", "backend_why", "effort", "efforts", "solution", "inferences",
        "solution_age_now_ms", "solution_age_ms", "view_error_estimated_now_mm", "view_error_estimated_mm",
        "view_error_mm", "light_age_s", "plan",
    ),
    "panels": ("panels", "presented", "dropped", "missed_blanks", "photon_now_ms", "photon_ms", "interval_ms",
               "stage_ms", "overhead_ms", "skew_ms"),
    "service": (),
}  # fmt: skip
FIRST = (
    "ok", "state", "reason", "scene", "model", "fps_now", "solutions_per_s_now", "live_db", "light_db", "missing",
    "faults", "paused", "flat_asked",
)  # fmt: skip


def status_lines(status: Mapping[str, Any]) -> Iterator[str]:
    """Yield the lines of a status: five that summarise it, then one group of fields after the other."""
    yield from _summary(status)
    known = {*FIRST, *(name for names in GROUPS.values() for name in names)}
    for group, names in GROUPS.items():
        shown = names if group != "service" else tuple(name for name in status if name not in known)
        lines = list(lines_of({name: _worded(name, status[name]) for name in shown if name in status}))
        if lines:
            yield ""
            yield group
            yield from (f"  {line}" for line in lines)


def _worded(name: str, value: Any) -> Any:
    if name == "people":
        return ", ".join(f"person {person['number']}" for person in value) + " served" if value else "none served"
    if name == "effort" and value:
        return effort_in_words(value)
    if name == "efforts" and value:
        return "; ".join(f"{effort_in_words(effort)} {in_words(seconds)} s" for effort, seconds in value.items())
    return value


def _summary(status: Mapping[str, Any]) -> Iterator[str]:
    state, reason = status.get("state", "starting"), status.get("reason")
    reason = (reason or "").removeprefix(f"{state.removeprefix('degraded: ')}: ")  # names the missing part again
    wishes = ["paused"] if status.get("paused") else []
    yield _line("state", f"{state} ({reason})" if reason else state, *wishes)
    if "scene" in status:
        yield _line("shows", f"{status['scene']} with the model {status.get('model')}")
    if status.get("fps_now") is not None:
        solutions = in_words(float(status.get("solutions_per_s_now") or 0.0))
        yield _line("rate", f"{in_words(float(status['fps_now']))} refreshes/s, {solutions} solutions/s")
    quality = [
        f"{in_words(float(status[name]))} dB ({meaning})"
        for name, meaning in (("live_db", "live_db, of the moving view"), ("light_db", "light_db, at the eyes now"))
        if status.get(name) is not None
    ]
    if "scene" in status:
        yield _line("quality", *quality or ["not measured (`run --out` and `try` measure it)"])
    problems = [f"{part}: {why}" for part, why in (status.get("missing") or {}).items()]
    problems += [f"{count} x {part} since startup" for part, count in (status.get("faults") or {}).items()]
    yield _line("faults", *problems or ["none"])


def _line(name: str, *parts: str) -> str:
    return f"{name:10} {'; '.join(parts)}"
