"""`phasestack setup`: from step to step with a person, resumable, and a page of figures at the end."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import typer

from calib.keys import Key, TerminalKeys, first_of
from calib.setup_steps import STEPS, Setup, Step, Stopped
from calib.setup_world import RealWorld, SimulatedWorld, World
from runtime.config import Settings, load_settings
from runtime.errors import InputError, PhasestackError
from runtime.report.page import Page, section_of
from runtime.support import foreign
from runtime.support.artifacts import write_json, write_text

PROGRESS_BYTES_MAX = 4 << 20


def progress_path(config: Path) -> Path:
    """Where it is kept how far a configuration's setting up has come: beside it."""
    return config.with_name(f"{config.stem}.setup.json")


def read_progress(path: Path) -> dict[str, Any]:
    """The figures of the steps that are done, by name. Raises InputError."""
    if not foreign.is_there(path):
        return {}
    try:
        found = foreign.read_json(path, most_bytes=PROGRESS_BYTES_MAX)
        done = found["done"]
        steps = {step.name: done[step.name] for step in STEPS if step.name in done}
    except (InputError, KeyError, TypeError):
        raise InputError(path, "done", "is not what setup wrote: remove the file to begin anew") from None
    if not all(isinstance(figures, dict) for figures in steps.values()):
        raise InputError(path, "done", "is not what setup wrote: remove the file to begin anew")
    return steps


def run_setup(
    config: Path,
    *,
    out: Path,
    simulate: bool,
    seed: int,
    photos: Path | None,
    device: str | None,
    again: bool,
    to_stderr: bool = False,
) -> tuple[dict[str, Any], str]:
    """Walk through every step; answers the summary and its text. Raises InputError."""

    def say(text: str) -> None:
        typer.echo(text, err=to_stderr)

    settings = load_settings(config if foreign.is_there(config) else None)
    done = {} if again else read_progress(progress_path(config))
    world: World
    if simulate:
        world = SimulatedWorld(settings.stack.stack(), seed=seed)
        world.listen(say)
    else:
        world = RealWorld(photos=photos, device=device)
    keys = TerminalKeys()
    setup = Setup(config, out, world, first_of(keys.poll, world.keys), say, done)
    say("setting up a display: Enter: do it; n: skip (what is done stays); p: the step before; q: stop, go on later")
    try:
        finished = walk_through(setup)
    finally:
        keys.close()
        world.close()
    return summarise(setup, finished=finished)


def walk_through(setup: Setup) -> bool:
    """Every step until the last, or q. True where the end was reached."""
    number = next((n for n, step in enumerate(STEPS) if step.name not in setup.done), 0)
    problem = ""
    while number < len(STEPS):
        step = STEPS[number]
        _announce(setup, step, number, problem=problem)
        key, problem = setup.key(), ""
        if key is Key.QUIT:
            return False
        if key in (Key.PREVIOUS, Key.LEFT):
            number = max(0, number - 1)
        elif key in (Key.NEXT, Key.RIGHT):
            number += 1
        elif key is Key.ACCEPT:
            problem = _problem_of(setup, step)
            number += not problem
    return True


def _announce(setup: Setup, step: Step, number: int, *, problem: str) -> None:
    """A step, in the terminal and on the panels; what was wrong with it, if it was tried, on the panels."""
    state = "done before" if step.name in setup.done else "not done yet"
    lines = [f"Step {number + 1} of {len(STEPS)}: {step.title}", step.what, f"({state})",
             "Enter: do it   n: skip   p: back   q: stop"]  # fmt: skip
    setup.say("\n" + "\n".join(lines))
    setup.world.show_words(setup.settings, [*lines, problem] if problem else lines)


def _problem_of(setup: Setup, step: Step) -> str:
    """Run a step. What was wrong is told and answered; empty: it is done."""
    try:
        figures = step.run(setup)
    except (Stopped, PhasestackError) as error:
        told = "stopped: what was not finished is not written into the configuration"
        problem = told if isinstance(error, Stopped) else f"it did not work: {error}"
        setup.say(problem)
        return problem
    setup.done[step.name] = figures
    write_json(progress_path(setup.config), {"done": setup.done})
    setup.say(f"step {step.name}: done")
    return ""


def summarise(setup: Setup, *, finished: bool) -> tuple[dict[str, Any], str]:
    """Check the configuration, write the page of figures, and say what comes next."""
    settings = setup.settings
    missing = [step.name for step in STEPS if step.name not in setup.done]
    summary: dict[str, Any] = {
        "config": str(setup.config),
        "finished": finished,
        "done": setup.done,
        "missing": missing,
        "simulated": setup.world.simulated,
    }
    rows = figure_rows(setup, settings)
    lines = [f"{row[0]}: {row[1]}" for row in rows[1:]]
    if finished:
        notes = [note for figures in setup.done.values() for note in figures.get("notes", [])]
        lead = f"{setup.config}: what each step came to."
        page = Page("Setting up", lead, [section_of("Figures", rows)], notes=notes)
        write_text(setup.out / "index.html", page.html())
        write_json(setup.out / "setup.json", summary)
        lines.append(f"{setup.out / 'index.html'} has the figures; {setup.config} is valid")
        lines += _next(setup, settings)
    if missing:
        lines.append(f"not done: {', '.join(missing)} (the same command goes on there)")
    return summary, "\n".join(lines)


def figure_rows(setup: Setup, settings: Settings) -> list[list[str]]:
    """The table of figures: what each step is worth."""
    rows = [["", "figure"]]
    done = setup.done
    if "identify" in done:
        rows.append(["panels", f"{len(settings.output.panels)} bound to their monitors"])
    if "geometry" in done:
        gap_mm = (settings.stack.x_m[-1] - settings.stack.x_m[0]) / (len(settings.stack.x_m) - 1) * 1e3
        near, far = settings.calibration.viewing_m
        rows.append(["geometry", f"{settings.stack.width_m * 1e3:.1f} x {settings.stack.height_m * 1e3:.1f} mm, gaps "
                     f"{gap_mm:.2f} mm; viewers {near:g} to {far:g} m away"])  # fmt: skip
    if "registration" in done:
        db = done["registration"]["psnr_db"]
        gain = db["registered"] - db["as configured"]
        rows.append(["eyes see, panels registered", f"{db['registered']:.1f} dB (a perfect stack: "
                     f"{db['perfect stack']:.1f}; without the registration: {db['as configured']:.1f}; it is worth "
                     f"{gain:.1f} dB)"])  # fmt: skip
        rows.append(["its uncertainty", f"{done['registration']['eye_error_mm']:.2f} mm at the eye"])
    if "grey" in done:
        db = done["grey"]["psnr_db"]
        which = ", ".join(str(number) for number in done["grey"]["panels"])
        rows.append(["eyes see, grey curves measured", f"{db['with curves']:.1f} dB (panels that follow exactly: "
                     f"{db['perfect panels']:.1f}; without curves: {db['without']:.1f}; they are worth "
                     f"{db['with curves'] - db['without']:.1f} dB); of panels {which}"])  # fmt: skip
    if "sensor" in done:
        rows.append(["sensor", done["sensor"]["sensor"]])
    if "calibration" in done:
        figures = done["calibration"]
        db = figures["expected_db"]
        rows.append(["error of the eyes' places", f"{figures['eye_error_mm']:.1f} mm expected, from "
                     f"{figures['pairs']} pairs, {figures['rms_mm']:.1f} mm off on average; it costs "
                     f"{db['eyes known exactly'] - db['as calibrated']:.1f} dB "
                     f"({db['eyes known exactly']:.1f} to {db['as calibrated']:.1f})"])  # fmt: skip
    if "service" in done:
        rows.append(["service", f"{len(done['service']['files'])} files: {done['service']['commands'][0]}"])
    return rows


def _next(setup: Setup, settings: Settings) -> list[str]:
    if setup.world.simulated:
        return [f"look: phasestack run --config {setup.config} --replay demo --headless --frames 60 --out run"]
    return [
        f"try it: phasestack run --config {setup.config}",
        f"check it: phasestack doctor --config {setup.config}",
        *(["at every start: " + "; ".join(setup.done["service"]["commands"])] if "service" in setup.done else []),
    ]
