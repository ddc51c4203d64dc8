"""`phasestack setup`: from step to step with a person, resumable, and the figures at the end."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import typer

from calib.hardware import SetupHardware
from calib.keys import TerminalKeys
from calib.setup_steps import STEPS, Setup, SetupStep, SetupStopped
from calib.simulated import SimulatedHardware
from runtime.config import load_settings
from runtime.errors import InputError, PhasestackError
from runtime.support import untrusted_input
from runtime.support.artifacts import write_json

MAX_PROGRESS_BYTES = 4 << 20  # of setup.json


def progress_path(config: Path) -> Path:
    """The file beside a configuration that records the setup's progress."""
    return config.with_name(f"{config.stem}.setup.json")


def read_progress(path: Path) -> dict[str, Any]:
    """The figures of the steps that are done, by name. Raises InputError."""
    if not untrusted_input.is_there(path):
        return {}
    try:
        found = untrusted_input.read_json(path, most_bytes=MAX_PROGRESS_BYTES)
        done = {step.name: dict(found["done"][step.name]) for step in STEPS if step.name in found["done"]}
    except (InputError, KeyError, TypeError, ValueError):
        raise InputError(path, "done", "is not what setup wrote: remove the file to begin anew") from None
    return done


def run_setup(
    config: Path, *, out: Path, photos: Path, simulate: bool, seed: int, to_stderr: bool
) -> tuple[dict[str, Any], str]:
    """Walk through every step; returns the summary and its text. Raises InputError."""

    def say(text: str) -> None:
        typer.echo(text, err=to_stderr)

    settings = load_settings(config if untrusted_input.is_there(config) else None)
    done = read_progress(progress_path(config))
    keys = TerminalKeys()
    hardware = (
        SimulatedHardware(keys.poll, settings.stack.stack(), say=say, photos=photos, seed=seed)
        if simulate
        else SetupHardware(keys.poll, photos=photos)
    )
    setup = Setup(config, out, hardware, say, keys.line, done)
    try:
        finished = walk_through(setup)
    finally:
        keys.close()
        hardware.close()
    return summarise(setup, finished=finished)


def walk_through(setup: Setup) -> bool:
    """Every step until the last, or q. True where the end was reached."""
    number = next((n for n, step in enumerate(STEPS) if step.name not in setup.done), 0)
    while number < len(STEPS):
        step = STEPS[number]
        state = "done before" if step.name in setup.done else "not done yet"
        setup.say(f"\nStep {number + 1} of {len(STEPS)}: {step.title}\n{step.what}\n({state})")
        try:
            answer = setup.ask("Enter: do it; n: skip, what is done stays; p: the step before", "do it")
        except SetupStopped:
            return False
        if answer == "p":
            number = max(0, number - 1)
        elif answer == "n" or (answer == "do it" and _is_done(setup, step)):
            number += 1
    return True


def _is_done(setup: Setup, step: SetupStep) -> bool:
    """Run a step."""
    try:
        figures = step.run(setup)
    except (SetupStopped, PhasestackError) as error:
        stopped = "stopped: what was not finished is not written into the configuration"
        setup.say(stopped if isinstance(error, SetupStopped) else f"it did not work: {error}")
        return False
    setup.done[step.name] = figures
    write_json(progress_path(setup.config), {"done": setup.done})
    setup.say(f"step {step.name}: done: {figures['text']}")
    return True


def summarise(setup: Setup, *, finished: bool) -> tuple[dict[str, Any], str]:
    """Write the figures, and say what comes next."""
    missing = [step.name for step in STEPS if step.name not in setup.done]
    summary: dict[str, Any] = {
        "config": str(setup.config),
        "finished": finished,
        "done": setup.done,
        "missing": missing,
        "simulated": setup.hardware.simulated,
    }
    lines = [f"{step.title}: {setup.done[step.name].get('text', '')}" for step in STEPS if step.name in setup.done]
    if finished:
        lines += [f"note: {note}" for figures in setup.done.values() for note in figures.get("notes", [])]
        write_json(setup.out / "setup.json", summary)
        lines.append(f"{setup.out / 'setup.json'} has the figures; {setup.config} is valid")
        if setup.hardware.simulated:
            lines.append(f"look: phasestack run --config {setup.config} --replay demo --headless --frames 60 --out run")
        else:
            lines.append(f"try it: phasestack run --config {setup.config}")
            lines.append(f"check it: phasestack doctor --config {setup.config}")
    if missing:
        lines.append(f"not done: {', '.join(missing)} (the same command goes on there)")
    return summary, "\n".join(lines)
