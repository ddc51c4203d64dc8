"""Guide the user through setting up a display, which can be interrupted and resumed."""

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

MAX_PROGRESS_BYTES = 4 << 20  # size limit for setup.json


def progress_path(config: Path) -> Path:
    """Return the path of the file that records the setup's progress, next to the configuration."""
    return config.with_name(f"{config.stem}.setup.json")


def read_progress(path: Path) -> dict[str, Any]:
    """Return the finished steps' figures by step. Raises InputError if the file is invalid."""
    if not untrusted_input.is_there(path):
        return {}
    try:
        progress = untrusted_input.read_json(path, most_bytes=MAX_PROGRESS_BYTES)
        done = {step.name: dict(progress["done"][step.name]) for step in STEPS if step.name in progress["done"]}
    except (InputError, KeyError, TypeError, ValueError):
        raise InputError(path, "done", "was not written by `phasestack setup`; delete the file to start over") from None
    return done


def run_setup(
    config: Path, *, out: Path, photos: Path, simulate: bool, seed: int, to_stderr: bool
) -> tuple[dict[str, Any], str]:
    """Create or change a configuration interactively, and return the summary as a dictionary and as text.
    Reports and the configuration's files go to `out`, the user's photographs to `photos`. Raises InputError.
    """

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
    """Run the steps from the first unfinished one. Returns False if the user stops."""
    number = next((n for n, step in enumerate(STEPS) if step.name not in setup.done), 0)
    while number < len(STEPS):
        step = STEPS[number]
        state = "already done" if step.name in setup.done else "not done yet"
        setup.say(f"\nStep {number + 1} of {len(STEPS)}: {step.title}\n{step.what}\n({state})")
        try:
            answer = setup.ask("Enter: start this step, n: skip it and keep earlier results, p: previous step", "start")
        except SetupStopped:
            return False
        if answer == "p":
            number = max(0, number - 1)
        elif answer == "n" or (answer == "start" and _is_done(setup, step)):
            number += 1
    return True


def _is_done(setup: Setup, step: SetupStep) -> bool:
    """Run a step and record its figures. Returns False if the step failed or was stopped."""
    try:
        figures = step.run(setup)
    except (SetupStopped, PhasestackError) as error:
        stopped = "stopped; unfinished changes were not written to the configuration"
        setup.say(stopped if isinstance(error, SetupStopped) else f"failed: {error}")
        return False
    setup.done[step.name] = figures
    write_json(progress_path(setup.config), {"done": setup.done})
    setup.say(f"step {step.name} is done: {figures['text']}")
    return True


def summarise(setup: Setup, *, finished: bool) -> tuple[dict[str, Any], str]:
    """Return the summary as a dictionary and as text with the next commands, and write it if finished."""
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
        lines.append(f"the configuration {setup.config} is valid; the figures are in {setup.out / 'setup.json'}")
        if setup.hardware.simulated:
            lines.append(
                f"to try the setup, run: phasestack run --config {setup.config} --replay demo --headless "
                "--frames 60 --out run"
            )
        else:
            lines.append(f"to try the setup, run: phasestack run --config {setup.config}")
            lines.append(f"to check the setup, run: phasestack doctor --config {setup.config}")
    if missing:
        lines.append(f"steps not done: {', '.join(missing)}; run the same command again to continue")
    return summary, "\n".join(lines)
