"""What a name that is gone was replaced by: one line a name, shown to whoever still uses it. All rooms add theirs."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import takewhile

# A setting (`section.key`), or a whole section (`section`).
REMOVED_SETTINGS: dict[str, str] = {
    "plan.dead_band_mm": "take the line out: only a head at rest is not solved for anew",
    "plan.focus": "plan.enabled switches every saving",
    "plan.most_band_mm": "take the line out: a resting head's place is renewed after 1 mm",
    "plan.one_channel": "plan.enabled switches every saving",
    "plan.one_eye": "plan.enabled switches every saving",
    "plan.range_deg": "take the line out: an eye farther than 80 degrees off the display's axis can't see it",
    "plan.reuse": "plan.enabled switches every saving",
    "model.pupil_mm": "take the line out: a pupil is 4 mm wide; model.eye_sigma_mm takes any figure",
    "model.transfer": "take the line out: nothing ever read it",
    "content.up": 'set content.axes to both axes, up first, such as "+z -y"',
    "content.out": 'set content.axes to both axes, up first, such as "+z -y"',
    "content.quilt": 'set content.layout to its columns, rows and aspect, such as "qs8x6a0.75"',
    "content.at_end": "films repeat; a playlist with `repeat = false` ends",
    "content.samples": "take the line out: outlines are smooth without",
    "calibration.ipd_sigma_m": "take the line out: the scale is learned from the pairs alone",
    "calibration.ipd_tolerance": "take the line out: it is 4%",
    "calibration.scale_sigma": "take the line out: it is 2%; `calibrate solve --method fixed-scale` keeps a scale",
    **dict.fromkeys(
        (
            "tracker.horizon_max_s",
            "tracker.acceleration",
            "tracker.stay_s",
            "tracker.turn_acceleration",
            "tracker.speed_max",
            "tracker.loss_s",
            "tracker.decay_s",
            "tracker.revive_s",
        ),
        "take the line out: the tracker follows the noise that the sensor says, or tracker.noise_m",
    ),
    "tracker.confidence_min": "take the line out: samples below 0.3 are not used",
    "tracker.ipd_min_m": "take the line out: eyes are 50 to 78 mm apart, or no person's",
    "tracker.ipd_max_m": "take the line out: eyes are 50 to 78 mm apart, or no person's",
    "tracker.blend_s": "take the line out: the picture goes flat, and comes back, in 0.3 s",
    "sensor.start_s": "take the line out: a recording is played from its beginning",
    "sensor.reopen_backoff_s": "take the line out: a lost sensor is reopened after 0.25 s, then every 0.5 s",
    "sensor.reopen_backoff_max_s": "take the line out: a lost sensor is reopened after 0.25 s, then every 0.5 s",
    "sensor.open_timeout_s": "take the line out: opening is given up, and tried anew, after 10 s",
    "loop.solver_late_s": "take the line out: solutions that take more than 0.5 s are reported as late",
    "loop.solver_abandon_s": "take the line out: a solver that does not answer for 10 s is made anew",
    "detector": "take the section out: a face beyond 4 m is no viewer's; one not seen for 1 s makes way for another",
    "limits": "take the section out: what files may hold is the same everywhere",
    "service.log_format": "`journalctl -o json` makes objects of the lines",
    "service.group": "the socket is of the group `phasestack`",
    "service.blackbox_folder": "black boxes are in the state folder, under systemd /var/lib/phasestack/blackbox",
    "sensor.record_max_s": "`record --seconds`; without it, ten minutes",
    "sensor.record_max_mib": "take the line out: a recording has 2 GiB at most",
    "service.log_level": "take the line out: from `info` on; `journalctl -p warning` shows less",
    "service.blackbox_mib": "the black box keeps 32 MiB at most",
    "service.blackbox_files": "the folder keeps 20 black boxes, of each kind the first and the last",
    "content.external": 'a class of your own shows another program\'s pictures: scene = "module:Class"',
}

# A command, or an option of one: `bench survey`, `run --record`.
REMOVED_COMMANDS: dict[str, str] = {
    "ctl budget": "set model.budget_ms in the configuration, then `ctl reload`",
    "ctl restart": "`systemctl restart phasestack`",
    "plan --budget-ms": "set model.budget_ms in the configuration",
    "plan --survey": "`plan --scene NAME` measures one scene, with the plan and without",
    "ctl next": "`ctl scene next`",
    "plan --out": "`plan --json` prints what it measured",
    "plan --quick": "`plan --scale 0.5` is as quick",
    "report --fresh": "take it out: nothing is kept; the page grows while it is measured",
    "bench robust": "`report --pairs DIR` measures pairs of your own",
    "bench passes": "nothing: it was a developer's count of OpenGL passes",
    "bench eyes --chain": "`bench eyes FOLDER` says in mm how far off the eyes are; `run --out` measures dB",
    "bench --backend": "`solve --backend gl --repeat 20` times a backend",
    "solve --config": "take it out: the defaults hold; --backend and --no-plan are options",
    "demo --model": "`run --replay demo --headless --max-speed --model NAME --out DIR`",
    "demo --scale": "`run --replay demo --headless --max-speed --scale F --out DIR`",
    "run --record": "`ctl blackbox` writes the last minutes, `record` the sensor, `run --out` every refresh",
    "run --record-images": "`record --images`",
    "export --precision": "models are exported in 32 bits, which is what ships and what is measured",
    "export --opset": "take it out: operator set 17 is what every supported runtime takes",
    "export --dynamic": "export each size with --width and --height",
    "run --budget-ms": "set model.budget_ms in the configuration",
    "calibrate methods": "`calibrate solve` prints every method's figures for your pairs",
    "calibrate panels board": "`calibrate panels --show`",
    "calibrate panels photo": "`calibrate panels --photos FOLDER --out FOLDER`",
    "calibrate panels photo-trial": "`setup --simulate` photographs and registers a simulated display",
    "calibrate panels simulate": "`setup --simulate` photographs and registers a simulated display",
    "calibrate panels vernier": "a phone's photographs are better: `calibrate panels --show`, then --photos",
    "calibrate panels charts": "a phone's photographs are better: `calibrate panels --show`, then --photos",
    "calibrate panels fit": "a phone's photographs are better: `calibrate panels --show`, then --photos",
    "calibrate panels cost": "`calibrate panels` says what is uncertain in mm at the eye",
    "calibrate panels grey": "`calibrate grey`",
    "calibrate panels grey-chart": "`calibrate grey --panel N --show`",
    "calibrate capture --marks": "capture from the live sensor; recordings that know their true eyes need no marks",
    "calibrate capture --again": "undo (u) takes a pair back; without its row it is asked for again",
    "calibrate charts --show": "`calibrate capture --show` shows each chart on the panels",
    "calibrate charts --kind": "charts are for both eyes at once",
    "calibrate charts --check": "`reference-fused.png` shows what an eye sees",
    "calibrate solve --rollback": "past versions are beside the file: copy the one you want, as calibration.1.toml",
    "calibrate solve --sensor-unit": "pairs are in metres",
    "calibrate solve --stack-unit": "pairs are in metres",
    "calibrate solve --serial": "a column `sensor_serial` in the pairs",
    "calibrate report --pairs": "`calibrate solve` writes the pairs into its file",
    "identify --ask": "`setup`: its first step asks which monitor is which panel",
    "identify --all": "take it out: Enter goes from panel to panel, --panel N shows one",
    "identify --out": "take it out: cards are shown on the monitors themselves",
    "setup --again": "p goes a step back; every step can be done again",
    "export --base-width": "take it out: a checkpoint tells its own width",
    "report --compare": "take it out: it compares, but with --quick",
    "report --no-compare": "`report --quick` leaves the published network out",
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
