"""The steps of setting up, each for itself: what it asks, what it writes into the configuration, what came of it."""

from __future__ import annotations

import os
import shlex
import subprocess
from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from calib.board import boards
from calib.capture_run import capture_live
from calib.config_file import put, put_lut, put_monitors, rewrite
from calib.grey_chart import grey_chart, lut_from_photographs
from calib.hardware import Say, SetupHardware
from calib.keys import TYPED, Key
from calib.registration_run import register_photos
from calib.service_files import gather
from calib.solve_run import solve_file
from calib.viewpoints import IPD_M
from runtime.config import Settings, load_settings
from runtime.errors import InputError
from runtime.panels.geometry import Arrow, mounting_of
from runtime.panels.monitors import Monitor
from runtime.sensor.registry import DRIVERS
from runtime.support import untrusted_input

Figures = dict[str, Any]
MIN_PAIRS = 9
SERVICE_FOLDER = "/etc/phasestack"
ARROWS: dict[Key, Arrow] = {Key.UP: "up", Key.DOWN: "down", Key.LEFT: "left", Key.RIGHT: "right"}


class Stopped(Exception):
    """The person wants to go on another time."""


@dataclass
class Setup:
    """What every step works with."""

    config: Path
    out: Path  # folder of reports, and of what the configuration names
    hardware: SetupHardware
    say: Say
    done: dict[str, Figures] = field(default_factory=dict)  # of earlier steps, by name

    @property
    def settings(self) -> Settings:
        """The configuration as it is now."""
        return load_settings(self.config if untrusted_input.is_there(self.config) else None)

    def ask(self, question: str, keys: str, *, before: str = "") -> Key:
        """The key that answers a question, asked in the terminal and on the panels. before: what went wrong.

        Raises Stopped for q.
        """
        if before:
            self.say(before)
        self.say(f"{question}  ({keys}; q: stop)")
        lines = (*question.splitlines(), f"{keys}; q: stop", before)
        self.hardware.show_words(self.settings, [line for line in lines if line])
        key = self.hardware.key()
        if key is Key.QUIT:
            raise Stopped
        return key

    def write(self, change: Callable[[Any], None]) -> None:
        """Change the configuration by a function of its document. Raises InputError."""
        rewrite(self.config, change)


@dataclass(frozen=True, slots=True)
class Step:
    """One step."""

    name: str
    title: str
    what: str  # one line for a person
    run: Callable[[Setup], Figures]


def identify(setup: Setup) -> Figures:
    """Which monitor is which panel, rear to front, and how each is mounted; one monitor at a time shows a card."""
    hardware, count = setup.hardware, setup.settings.stack.stack().count
    monitors = hardware.monitors()
    if len(monitors) < count:
        raise InputError(setup.config, "stack.x_m", f"{len(monitors)} monitors for {count} panels")
    free, taken = list(range(len(monitors))), list[int]()  # the first of those that are free shows its card
    tables: list[dict[str, Any]] = []

    def ask(question: str, keys: str, answers: Container[Key]) -> Key:
        setup.say(f"{monitors[free[0]]} shows its card, the others are clear. {question} ({keys}; q: stop)")
        hardware.show_card(free[0], [question, f"{keys}; q: stop"])
        while (key := hardware.key()) not in answers:
            if key is Key.QUIT:
                raise Stopped
        return key

    arrows: list[Arrow] = []  # of the panels that are taken, and of the next one once it is known
    asked = 0  # of the panel: whether it is the one, its arrow, its writing
    while len(tables) < count:
        place = {0: "the rearmost, at the backlight", count - 1: "the front one"}.get(len(tables), "the next one")
        question, keys, answers = (
            (f"Is it panel {len(tables)}, {place}?", "Enter: yes, n: another monitor", {Key.ACCEPT, Key.NEXT}),
            ("Which way does its arrow point, seen from the front?", "arrow keys", set(ARROWS)),
            ("Does its writing read rightly?", "Enter: yes, n: it is mirrored", {Key.ACCEPT, Key.NEXT}),
        )[asked]
        key = ask(question, f"{keys}, u: one back", answers | {Key.UNDO})
        if key is Key.UNDO:
            if asked == 0 and taken:
                free.insert(0, taken.pop())
                tables.pop()
                asked = 3
            elif asked == 2:
                arrows.pop()
            asked = max(0, asked - 1)
        elif asked == 0 and key is Key.NEXT:
            free.append(free.pop(0))
        elif asked < 2:
            arrows += [ARROWS[key]] if asked == 1 else []
            asked += 1
        else:
            rotation_deg, mirror = mounting_of(arrows[-1], mirrored=key is Key.NEXT)
            named = _name_of(monitors[free[0]], monitors)
            tables.append(named | {"rotation_deg": rotation_deg, "mirror": mirror})
            taken.append(free.pop(0))
            asked = 0
    setup.write(lambda document: put_monitors(document, tables))
    return {"text": f"{count} bound to their monitors"}


def _name_of(monitor: Monitor, monitors: Sequence[Monitor]) -> dict[str, Any]:
    """How a configuration names a monitor: by its serial where no other has it, else by its connector."""
    alone = [m.serial for m in monitors].count(monitor.serial) == 1
    return {"edid_serial": monitor.serial} if monitor.serial and alone else {"connector": monitor.connector}


@dataclass
class Dial:
    """A number that arrows change, or that is typed."""

    name: str
    value: float
    step: float
    low: float
    high: float
    show: Callable[[float], str]
    unknown: float | None = None  # the value to begin with, where 0 says that nothing is known

    def turn(self, steps: int) -> None:
        if self.unknown is not None and (self.value == 0 or self.value + steps * self.step < self.low):
            self.value = self.unknown if steps > 0 else 0.0
        else:
            self.value = min(max(self.value + steps * self.step, self.low), self.high)

    def take(self, typed: str) -> str:
        """What was typed, in the unit that it is shown in; returns why it can't be (empty: it is)."""
        unit = 1e-3 if self.show is _mm else 1.0
        try:
            value = float(typed) * unit
        except ValueError:
            return f"{typed} is no number"
        if not self.low <= value <= self.high:
            return f"{typed}: {self.name} is between {self.show(self.low)} and {self.show(self.high)}"
        self.value = value
        return ""


def _mm(value: float) -> str:
    return f"{value * 1e3:.1f} mm" if value else "not known"


def _m(value: float) -> str:
    return f"{value:.2f} m"


def geometry(setup: Setup) -> Figures:
    """Size of the panels, their gap, and where viewers stand: about; registration finds the gap exactly."""
    stack, calibration = setup.settings.stack, setup.settings.calibration
    gap_m = (stack.x_m[-1] - stack.x_m[0]) / (len(stack.x_m) - 1)
    dials = [
        Dial("width of a panel's picture", stack.width_m, 0.0001, 0.02, 5.0, _mm),
        Dial("its height", stack.height_m, 0.0001, 0.02, 5.0, _mm),
        Dial("from panel to panel", gap_m, 0.001, 0.002, 0.5, _mm),
        Dial("nearest viewer", calibration.viewing_m[0], 0.05, 0.2, 5.0, _m),
        Dial("farthest viewer", calibration.viewing_m[1], 0.05, 0.25, 8.0, _m),
        Dial("the eye separation of who will calibrate, if it is known (an optician's PD)", calibration.ipd_m, 0.0005,
             0.05, 0.08, _mm, unknown=IPD_M),
    ]  # fmt: skip
    _turn_dials(setup, dials)
    width_m, height_m, found_m, near_m, far_m, ipd_m = (round(dial.value, 5) for dial in dials)
    size: dict[str, Any] = {"width_m": width_m, "height_m": height_m}
    if abs(found_m - gap_m) > 1e-6:  # else distances that were measured stay as they are
        middle = (len(stack.x_m) - 1) / 2
        size["x_m"] = [round((index - middle) * found_m, 6) for index in range(len(stack.x_m))]
    viewing: dict[str, Any] = {"viewing_m": [near_m, far_m]}
    if ipd_m != calibration.ipd_m:
        viewing["ipd_m"] = ipd_m

    def change(document: Any) -> None:
        put(document, "stack", size)
        put(document, "calibration", viewing)

    setup.write(change)
    return {"text": f"{_mm(width_m)} by {_mm(height_m)}; viewers {_m(near_m)} to {_m(far_m)} away"}


def _turn_dials(setup: Setup, dials: list[Dial]) -> None:
    chosen, coarse = 0, 1  # which dial; how many of its steps at once
    typed, problem, before = "", "", list[tuple[int, float]]()  # what the dials were, to take back
    while True:
        lines = [f"{'>' if dial is dials[chosen] else ' '} {dial.name}: {dial.show(dial.value)}" for dial in dials]
        lines[chosen] += f" -> {typed}" if typed else ""
        keys = "digits, or left, right (f, c: finer, coarser): change; up, down: another number; u: one back"
        key, problem = setup.ask("\n".join(lines), f"{keys}; Enter: {'take it' if typed else 'all are right'}",
                                 before=problem), ""  # fmt: skip
        if key in (Key.LEFT, Key.RIGHT) or (typed and key is Key.ACCEPT):
            before.append((chosen, dials[chosen].value))
        if key not in TYPED and key not in (Key.ACCEPT, Key.UNDO):
            typed = ""
        match key:
            case key if key in TYPED:
                typed += TYPED[key]
            case Key.ACCEPT if typed:
                typed, problem = "", dials[chosen].take(typed)
            case Key.ACCEPT:
                return
            case Key.UNDO if typed:
                typed = typed[:-1]
            case Key.UNDO if before:
                chosen, value = before.pop()
                dials[chosen].value = value
            case Key.UP:
                chosen = (chosen - 1) % len(dials)
            case Key.DOWN:
                chosen = (chosen + 1) % len(dials)
            case Key.FINER:
                coarse = max(coarse // 10, 1)
            case Key.COARSER:
                coarse = min(coarse * 10, 100)
            case Key.LEFT:
                dials[chosen].turn(-coarse)
            case Key.RIGHT:
                dials[chosen].turn(coarse)


def registration(setup: Setup) -> Figures:
    """Where the panels truly are, from photographs of the boards."""
    setup.write(lambda document: None)  # an empty configuration where there was none
    settings = setup.settings
    pictures = setup.hardware.photographs(settings, boards(settings.stack.stack()), panel=None, say=setup.say)
    summary = register_photos(pictures, "photographs", setup.out / "registration", settings, config=setup.config)
    gaps = ", ".join(f"{gap * 1e3:.2f}" for gap in summary["gap_m"])
    figures = f"gaps {gaps} mm, from {summary['used']} photographs; what is uncertain is worth"
    return {"text": f"{figures} {summary['eye_error_mm']:.2f} mm at the eye", "notes": summary["notes"]}


def grey(setup: Setup) -> Figures:
    """What each panel makes of a grey, from photographs of its chart; a panel at a time, each kept at once."""
    stack = setup.settings.stack.stack()
    known = [bool(panel.lut) for panel in setup.settings.output.panels] or [False] * stack.count
    residuals = [0.0]
    number, problem = 0, ""
    while number < stack.count:
        state = "has a curve" if known[number] else "has no curve yet"
        keys = "Enter: measure it; n: leave it; u: the panel before"
        key, problem = setup.ask(f"panel {number} {state}", keys, before=problem), ""
        if key in (Key.UNDO, Key.PREVIOUS, Key.LEFT):
            number = max(0, number - 1)
        elif key in (Key.NEXT, Key.RIGHT):
            number += 1
        elif key is Key.ACCEPT:
            try:
                residuals.append(_measure_grey(setup, number))
            except InputError as error:
                problem = f"it did not work: {error}"
                continue
            known[number] = True
            number += 1
    if not any(known):
        setup.say("no panel has a curve: gammas stay as they are configured")
        raise Stopped
    which = ", ".join(str(n) for n, has in enumerate(known) if has)
    return {"text": f"of panels {which}, measured to {100 * max(residuals):.2f}%"}


def _measure_grey(setup: Setup, panel: int) -> float:
    """One panel's LUT into the configuration; returns how far the curve is off, of the range. Raises InputError."""
    settings = setup.settings
    stack = settings.stack.stack()
    charts = np.zeros((stack.count, stack.height_px, stack.width_px), np.uint8)
    charts[panel] = grey_chart(stack, panel)
    pictures = setup.hardware.photographs(settings, charts, panel=panel, say=setup.say)
    path = (setup.out / "grey" / f"panel-{panel}.csv").resolve()
    summary = lut_from_photographs(path, pictures, stack, panel=panel, source="photographs")
    setup.write(lambda document: put_lut(document, panel, str(path), panels=stack.count))
    residual = float(summary["residual"])
    setup.say(f"panel {panel}: taken, measured to {100 * residual:.2f}%")
    return residual


def sensor(setup: Setup) -> Figures:
    """Which depth sensor sees the viewer; tried at once."""
    settings = setup.settings
    names = [name for name in DRIVERS if name not in ("replay", "fixed")]
    if setup.hardware.simulated:
        names = ["replay"]
    chosen, problem = names.index(settings.sensor.driver) if settings.sensor.driver in names else 0, ""
    while True:
        question = f"depth sensor: {names[chosen]}"
        key, problem = setup.ask(question, "up, down: another; Enter: try it", before=problem), ""
        if key in (Key.UP, Key.DOWN):
            chosen = (chosen + (1 if key is Key.DOWN else -1)) % len(names)
        if key is not Key.ACCEPT:
            continue
        update: dict[str, Any] = {"driver": names[chosen]}
        if settings.sensor.driver != names[chosen]:
            update["source"] = ""
        tried = settings.model_copy(update={"sensor": settings.sensor.model_copy(update=update)})
        try:
            name = setup.hardware.open_sensor(tried)
            break
        except InputError as error:
            problem = f"it does not work: {error}"
    setup.write(lambda document: put(document, "sensor", update))
    return {"text": name}


def calibration(setup: Setup) -> Figures:
    """Where the sensor stands: a person goes from viewpoint to viewpoint."""
    pairs_path, target = setup.out / "pairs.csv", setup.out / "calibration.toml"
    count = capture_live(pairs_path, setup.settings, setup.hardware, show=True, say=setup.say)["pairs"]
    if count < MIN_PAIRS:
        setup.say(f"{count} pairs are kept in {pairs_path}; at least {MIN_PAIRS} are needed")
        raise Stopped
    summary = solve_file(pairs_path, target, settings=setup.settings)
    setup.write(lambda document: put(document, "calibration", {"file": str(target.resolve())}))
    text = f"{summary['eye_error_mm']:.1f} mm of error expected at the eye, from {summary['pairs']} pairs"
    return {"text": text, "notes": summary["warnings"]}


def service(setup: Setup) -> Figures:
    """A folder with all that the service reads, and the commands that apply it, which are run where they may be."""
    folder = (setup.out / "service").resolve()
    files = gather(setup.config, folder)
    sudo = "" if os.geteuid() == 0 else "sudo "
    commands = [
        f"{sudo}install --backup=numbered -D -m 644 -t {SERVICE_FOLDER} {shlex.quote(str(folder))}/*",
        f"{sudo}systemctl enable phasestack",
        f"{sudo}systemctl restart phasestack",
    ]
    told = "; ".join(commands)
    if setup.hardware.simulated or sudo:
        setup.say("the service reads its own copy of all this; apply it by\n  " + "\n  ".join(commands))
        return {"text": f"{len(files)} files; apply them by: {told}"}
    setup.hardware.let_go()  # the panels, which the service wants
    for command in commands:
        result = subprocess.run(["sh", "-c", command], capture_output=True, text=True, check=False)
        if result.returncode != 0:
            raise InputError(setup.config, "service", f"{command}: {result.stderr.strip() or 'failed'}")
    return {"text": f"{len(files)} files, applied: {told} (the files before: *.~1~)"}


STEPS = (
    Step("identify", "Which monitor is which panel", "each panel in turn shows a card; you say what you see", identify),
    Step("geometry", "Sizes and distances", "how large the panels are, about how far apart, where viewers stand",
         geometry),
    Step("registration", "Where the panels truly are", "a dozen photographs of the boards, by hand", registration),
    Step("grey", "What each panel makes of a grey", "two photographs of a chart, for each panel", grey),
    Step("sensor", "The depth sensor", "which one sees the viewer's eyes", sensor),
    Step("calibration", "Where the sensor stands", "you stand where lines fuse, and press Enter: 27 places, or 9 "
         "(q: enough)", calibration),
    Step("service", "At every start", "what the service reads is gathered in a folder and, by root, applied", service),
)  # fmt: skip
