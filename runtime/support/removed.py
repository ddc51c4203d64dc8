"""What took the place of a name that went lately, in a line, for whoever still uses it. All rooms add theirs.

What nothing took the place of is refused as any unknown name is: the line, or the option, is taken out.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import takewhile

# A setting (`section.key`), or a whole section (`section`).
REMOVED_SETTINGS: dict[str, str] = {
    **dict.fromkeys(
        ("plan.focus", "plan.one_channel", "plan.one_eye", "plan.reuse"), "plan.enabled switches every saving"
    ),
    "content.up": 'set content.axes to both axes, up first, such as "+z -y"',
    "content.out": 'set content.axes to both axes, up first, such as "+z -y"',
    "content.reading": "files of a preset stand as the supplement prints it, data-set folders as they were drawn",
    "service.log_format": "`journalctl -o json` makes objects of the lines",
    "service.group": "the socket is of the group `phasestack`",
    "service.blackbox_folder": "black boxes are in the state folder, under systemd /var/lib/phasestack/blackbox",
    "output.allow_rescaling": "set the monitors' mode to the stack's pixels",
    "sensor.record_max_s": "`record --seconds`; without it, ten minutes",
}

# A command, or an option of one: `bench survey`, `run --record`.
REMOVED_COMMANDS: dict[str, str] = {
    "ctl budget": "set model.budget_ms in the configuration, then `ctl reload`",
    "ctl next": "`ctl scene next`",
    "plan --eyes": "set sensor.fixed_eyes_m in the configuration",
    "bench eyes": "`python -m tests.eyes.benchmark FOLDER`, in the repository",
    "train --threads": "OMP_NUM_THREADS in the environment",
    "run --budget-ms": "set model.budget_ms in the configuration",
    "calibrate grey --series": "write the LUT itself: a CSV of phase and grey, 0 to 1",
    "calibrate capture --again": "p goes back, where Enter replaces the pair; without its row it is asked for again",
    "calibrate charts --show": "`calibrate capture --show` shows each chart on the panels",
    "calibrate charts --check": "`capture --show`: at the viewpoint the lines are single and clean",
    "page --host": "`ssh -L 8717:localhost:8717`, or a proxy on the display's machine",
    **dict.fromkeys(("status --socket", "ctl --socket", "page --socket"), "`--config FILE` whose service.socket it is"),
    "identify --seconds": "q ends it",
    "identify --panel": "n goes to the next panel",
    "identify --ask": "`setup`: its first step asks which monitor is which panel",
    "setup --again": "p goes a step back; every step can be done again",
    "config --check": "`doctor --config FILE` checks values, names and files, and tries what they name",
    "config --json": "`config` prints TOML",
    "setup --device": "photographs in the folder --photos",
}


def removed_command(arguments: Sequence[str]) -> tuple[str, str] | None:
    """The name that is gone among a command line's arguments, and what took its place; None: there is none.

    >>> removed_command(["ctl", "budget", "16"])[0], removed_command(["run", "--budget-ms=16"])[0]
    ('ctl budget', 'run --budget-ms')
    """
    words = list(takewhile(lambda argument: not argument.startswith("-"), arguments))
    options = [argument.partition("=")[0] for argument in arguments if argument.startswith("--")]
    commands = [" ".join(words[:count]) for count in (1, 2, 3)]
    for name in (*commands, *(f"{command} {option}" for command in commands for option in options)):
        if name in REMOVED_COMMANDS:
            return name, REMOVED_COMMANDS[name]
    return None
