"""Steps run by `phasestack setup`. Each asks questions, edits the configuration and reports figures."""

from __future__ import annotations

import os
import shlex
import subprocess
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import tomlkit

from calib.board import boards
from calib.capture import capture_live
from calib.config_file import put, put_monitors, put_panels, read_document, rewrite
from calib.grey_chart import grey_charts, lut_from_photographs
from calib.hardware import Say, SetupHardware
from calib.keys import Key
from calib.registration import register_photos
from calib.solve_run import solve_file
from runtime.config import Settings, load_settings
from runtime.errors import InputError
from runtime.panels.geometry import Arrow, mounting_of
from runtime.sensor.registry import DRIVERS
from runtime.support import untrusted_input
from runtime.support.artifacts import OutputFolder, write_bytes, write_text

Figures = dict[str, Any]
MIN_PAIRS = 9  # minimum number of viewpoints for a calibration, out of 27
SERVICE_FOLDER = "/etc/phasestack"
MAX_BYTES = 64 << 20  # size limit for each file copied for the service
ARROWS: dict[Key, Arrow] = {Key.UP: "up", Key.DOWN: "down", Key.LEFT: "left", Key.RIGHT: "right"}
YES_NO = {Key.ACCEPT: True, Key.NEXT: False}


class SetupStopped(Exception):
    """Raised when the user stops a step or the setup."""


@dataclass
class Setup:
    """State shared by all setup steps."""

    config: Path  # configuration file
    out: Path  # folder for reports and for files that the configuration uses
    hardware: SetupHardware
    say: Say  # shows a line of text to the user
    line: Callable[[], str]  # returns the next line that the user types
    done: dict[str, Figures] = field(default_factory=dict)  # the finished steps' figures, keyed by step name

    @property
    def settings(self) -> Settings:
        """Current configuration, loaded on every access. If the file is missing, the defaults apply."""
        return load_settings(self.config if untrusted_input.is_there(self.config) else None)

    def ask(self, question: str, default: str = "") -> str:
        """Ask a question and return the answer, or `default` for an empty line. Raises SetupStopped for q."""
        self.say(f"{question} [{default or 'Enter'}; q: stop]")
        answer = self.line()
        if answer == "q":
            raise SetupStopped
        return answer or default


@dataclass(frozen=True, slots=True)
class SetupStep:
    """A setup step, with the text that introduces it to the user."""

    name: str
    title: str
    what: str  # one-line explanation
    run: Callable[[Setup], Figures]  # performs the step and returns its figures


def identify(setup: Setup) -> Figures:
    """Step 1: assign monitors to panels and find each one's mounting, by questions about a card."""
    hardware, count = setup.hardware, setup.settings.stack.stack().count
    monitors = hardware.monitors()
    if len(monitors) < count:
        raise InputError(
            setup.config, "stack.x_m", f"lists {count} panels, but only {len(monitors)} monitors are connected"
        )
    free = list(range(len(monitors)))  # unassigned monitors; the first one shows its card
    tables: list[dict[str, Any]] = []

    def ask(question: str, keys: str, answers: Mapping[Key, Any]) -> Any:
        hardware.show_card(free[0], [question, f"{keys}; q: stop"])
        setup.say(f"{monitors[free[0]]} shows its card, and the other monitors are clear. {question} ({keys}, q: stop)")
        while (key := hardware.key()) not in answers:
            if key is Key.QUIT:
                raise SetupStopped
        return answers[key]

    while len(tables) < count:
        place = {0: "the rear panel, at the backlight", count - 1: "the front panel"}.get(len(tables), "the next panel")
        if not ask(f"Is this panel {len(tables)}, {place}?", "Enter: yes, n: no", YES_NO):
            free.append(free.pop(0))
            continue
        arrow = ask("Seen from the front, which way does the arrow point?", "arrow keys", ARROWS)
        readable = ask("Can you read the text, or is it mirrored?", "Enter: readable, n: mirrored", YES_NO)
        rotation_deg, mirror = mounting_of(arrow, mirrored=not readable)
        selection = monitors[free.pop(0)].selection(monitors)
        tables.append(selection | {"rotation_deg": rotation_deg, "mirror": mirror})
    rewrite(setup.config, lambda document: put_monitors(document, tables))
    return {"text": f"assigned {count} panels to their monitors"}


def geometry(setup: Setup) -> Figures:
    """Step 2: ask for the panels' size, the approximate gap (measured later) and viewing distances."""
    stack, calibration = setup.settings.stack, setup.settings.calibration

    def length_m(question: str, value_m: float, unit_m: float = 1e-3) -> float:
        """Ask for a length in units of `unit_m`, and return it in metres. An empty line keeps `value_m`."""
        while True:
            answer = setup.ask(f"{question}, {'mm' if unit_m == 1e-3 else 'm'}", f"{value_m / unit_m:.6g}")
            try:
                typed = float(answer) * unit_m
            except ValueError:
                setup.say(f"{answer} is not a number; try again")
                continue
            return value_m if abs(typed - value_m) < 1e-8 else round(typed, 7)

    size: dict[str, Any] = {
        "width_m": length_m("width of a panel's active area", stack.width_m),
        "height_m": length_m("height of a panel's active area", stack.height_m),
    }
    gap_m = (stack.x_m[-1] - stack.x_m[0]) / (len(stack.x_m) - 1)
    typed_m = length_m("distance from one panel to the next", gap_m)
    if typed_m != gap_m:  # otherwise the measured distances are kept
        middle = (len(stack.x_m) - 1) / 2
        size["x_m"] = [round((index - middle) * typed_m, 7) for index in range(len(stack.x_m))]
    near_m = length_m("nearest viewer", calibration.viewing_m[0], 1.0)
    far_m = length_m("farthest viewer", calibration.viewing_m[1], 1.0)
    ipd_m = length_m("pupillary distance of the person who calibrates (0 if unknown)", calibration.ipd_m)

    def change(document: Any) -> None:
        put(document, "stack", size)
        put(document, "calibration", {"viewing_m": [near_m, far_m], "ipd_m": ipd_m})

    rewrite(setup.config, change)
    width_mm, height_mm = (1e3 * size[name] for name in ("width_m", "height_m"))
    return {"text": f"panels of {width_mm:.1f} by {height_mm:.1f} mm, viewed from {near_m:.2f} to {far_m:.2f} m away"}


def registration(setup: Setup) -> Figures:
    """Step 3: measure the panels' actual poses from photographs of the calibration boards."""
    rewrite(setup.config, lambda document: None)  # creates an empty configuration if none exists
    settings = setup.settings
    pictures = setup.hardware.photographs(settings, boards(settings.stack.stack()), panel=None, say=setup.say)
    summary = register_photos(pictures, "photographs", setup.out / "registration", settings, config=setup.config)
    gaps = ", ".join(f"{gap * 1e3:.2f}" for gap in summary["gap_m"])
    figures = f"gaps of {gaps} mm measured from {summary['used']} photographs, with an uncertainty equivalent to"
    return {"text": f"{figures} {summary['eye_error_mm']:.2f} mm at the eye", "notes": summary["notes"]}


def grey(setup: Setup) -> Figures:
    """Step 4: measure each panel's grey curve from photographs of a chart, and save each immediately."""
    stack = setup.settings.stack.stack()
    known = [bool(panel.lut) for panel in setup.settings.output.panels] or [False] * stack.count
    residuals = [0.0]
    for number in range(stack.count):
        state = "has a curve" if known[number] else "has no curve yet"
        while setup.ask(f"panel {number} {state}; measure it now? (y or n)", "y") == "y":
            try:
                residuals.append(_measure_grey(setup, number))
            except InputError as error:
                setup.say(f"failed: {error}")
                continue
            known[number] = True
            break
    if not any(known):
        setup.say("no panel has a curve, so the display will use the configured gammas")
        raise SetupStopped
    numbers = ", ".join(str(n) for n, has in enumerate(known) if has)
    return {"text": f"curves of panels {numbers}, measured to {100 * max(residuals):.2f}%"}


def _measure_grey(setup: Setup, panel: int) -> float:
    """Measure a panel's grey curve, add it to the configuration and return its relative error."""
    settings = setup.settings
    stack = settings.stack.stack()
    pictures = setup.hardware.photographs(settings, grey_charts(stack, panel), panel=panel, say=setup.say)
    path = (setup.out / "grey" / f"panel-{panel}.csv").resolve()
    summary = lut_from_photographs(path, pictures, stack, panel=panel, source="photographs")
    rewrite(setup.config, lambda document: put_panels(document, "lut", {panel: str(path)}, panels=stack.count))
    residual = float(summary["residual"])
    setup.say(f"panel {panel}: curve accepted, with an error of {100 * residual:.2f}%")
    return residual


def sensor(setup: Setup) -> Figures:
    """Step 5: choose and test the depth sensor."""
    settings = setup.settings
    names = ["replay"] if setup.hardware.simulated else [name for name in DRIVERS if name not in ("replay", "fixed")]
    default = settings.sensor.driver if settings.sensor.driver in names else names[0]
    while True:
        chosen = setup.ask(f"depth sensor ({', '.join(names)})", default)
        update: dict[str, Any] = {"driver": chosen}
        if settings.sensor.driver != chosen:
            update["source"] = ""
        tried = settings.model_copy(update={"sensor": settings.sensor.model_copy(update=update)})
        try:
            name = setup.hardware.open_sensor(tried)
            break
        except InputError as error:
            setup.say(f"failed: {error}")
    rewrite(setup.config, lambda document: put(document, "sensor", update))
    return {"text": name}


def calibration(setup: Setup) -> Figures:
    """Step 6: measure the sensor's pose while the user moves from viewpoint to viewpoint."""
    pairs_path, target = setup.out / "pairs.csv", setup.out / "calibration.toml"
    count = capture_live(pairs_path, setup.settings, setup.hardware, show=True, say=setup.say)["pairs"]
    if count < MIN_PAIRS:
        setup.say(
            f"{pairs_path} contains {count} pairs, but at least {MIN_PAIRS} are needed; run this step again to add more"
        )
        raise SetupStopped
    summary = solve_file(pairs_path, target, settings=setup.settings)
    rewrite(setup.config, lambda document: put(document, "calibration", {"file": str(target.resolve())}))
    text = f"the expected error at the eye is {summary['eye_error_mm']:.1f} mm, from {summary['pairs']} pairs"
    return {"text": text, "notes": summary["warnings"]}


def service(setup: Setup) -> Figures:
    """Step 7: collect the service's files and install them, or print the commands without root."""
    folder = (setup.out / "service").resolve()
    files = gather(setup.config, folder)
    sudo = "" if os.geteuid() == 0 else "sudo "
    commands = [
        f"{sudo}install --backup=numbered -D -m 644 -t {SERVICE_FOLDER} {shlex.quote(str(folder))}/*",
        f"{sudo}systemctl enable phasestack",
        f"{sudo}systemctl restart phasestack",
    ]
    listed = "; ".join(commands)
    if setup.hardware.simulated or sudo:
        setup.say("the service uses copies of these files; to install them, run\n    " + "\n  ".join(commands))
        return {"text": f"gathered {len(files)} files; to install them, run: {listed}"}
    setup.hardware.let_go()  # the service needs the panels
    for command in commands:
        result = subprocess.run(["sh", "-c", command], capture_output=True, text=True, check=False)
        if result.returncode != 0:
            raise InputError(setup.config, "service", f"{command}: {result.stderr.strip() or 'failed'}")
    return {"text": f"installed {len(files)} files with: {listed} (backups of previous files end in .~1~)"}


def gather(config: Path, out: Path) -> list[str]:
    """Copy configuration, calibration and grey curves to a folder, and return their names. Raises
    InputError. All other files stay where they are, and the copied configuration refers to them by absolute paths.
    """
    if not config.exists():
        raise InputError(config, "", "does not exist yet; run the earlier steps first")
    settings = load_settings(config)
    document: Any = read_document(config)
    copies: dict[str, bytes] = {}
    for section, values in settings:
        for key, value in values:
            if key in document.get(section, {}) and isinstance(value, str):  # all paths are absolute here
                document[section][key] = value
    if settings.calibration.file:
        copies["calibration.toml"] = untrusted_input.read_bytes(settings.calibration.file, most_bytes=MAX_BYTES)
        document["calibration"]["file"] = "calibration.toml"
    for number, panel in enumerate(settings.output.panels):
        if panel.lut:
            name = f"panel-{number}.csv"
            copies[name] = untrusted_input.read_bytes(panel.lut, most_bytes=MAX_BYTES)
            document["output"]["panels"][number]["lut"] = name
    with OutputFolder(out) as folder:
        for name, data in copies.items():
            write_bytes(folder.staging / name, data)
        write_text(folder.staging / "phasestack.toml", tomlkit.dumps(document))
        load_settings(folder.staging / "phasestack.toml")
    return sorted(["phasestack.toml", *copies])


STEPS = (
    SetupStep("identify", "Assign monitors to panels",
              "each monitor shows a card in turn; say which panel you see", identify),
    SetupStep("geometry", "Enter sizes and distances",
              "enter the size of the panels, the approximate gap and the distance of the viewers", geometry),
    SetupStep("registration", "Register the panels",
              "take a dozen hand-held photographs of test patterns", registration),
    SetupStep("grey", "Measure the panels' grey curves", "take two photographs of a chart on each panel", grey),
    SetupStep("sensor", "Choose the depth sensor", "choose the sensor that tracks the viewer's eyes", sensor),
    SetupStep("calibration", "Calibrate the sensor",
              "at 9 to 27 viewpoints, stand where the lines fuse and press Enter; press q at the end", calibration),
    SetupStep("service", "The service", "gather the service's files and, if run as root, install them", service),
)  # fmt: skip
