"""The steps of setting up, each for itself: what it asks, what it writes into the configuration, what came of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from calib.config_file import put, put_lut, put_monitors, read_document, save_document
from calib.grey import fit_series
from calib.grey_run import pictures_series, write_lut
from calib.interview import Interview
from calib.keys import Key
from calib.pairs import PairsFile
from calib.photo_run import register_seen, wants_even
from calib.setup_service import gather
from calib.setup_world import Poll, Say, World
from calib.setup_worth import calibration_worth, grey_worth
from calib.solve_run import solve_file
from calib.viewpoints import IPD_M, grid
from calib.walk import Walk
from runtime.config import Settings, load_settings
from runtime.errors import InputError
from runtime.sensor.registry import driver_names
from runtime.support import foreign

Figures = dict[str, Any]
LEAST_PAIRS = 9
SERVICE_FOLDER = "/etc/phasestack"


@dataclass
class Setup:
    """What every step works with."""

    config: Path
    out: Path  # folder of reports, and of what the configuration names
    world: World
    poll: Poll
    say: Say
    done: dict[str, Figures] = field(default_factory=dict)  # of earlier steps, by name

    @property
    def settings(self) -> Settings:
        """The configuration as it is now."""
        return load_settings(self.config if foreign.is_there(self.config) else None)

    def ask(self, question: str, keys: str, *, before: str = "") -> None:
        """In the terminal and on the panels: a question and the keys that answer it. before: what went wrong."""
        if before:
            self.say(before)
        self.say(f"{question}  ({keys})")
        self.world.show_words(self.settings, [line for line in (question, keys, before) if line])

    def key(self) -> Key:
        """Wait for a key."""
        while (key := self.poll()) is None:
            self.world.wait()
        return key


class Stopped(Exception):
    """The person wants to go on another time."""


@dataclass(frozen=True, slots=True)
class Step:
    """One step."""

    name: str
    title: str
    what: str  # one line for a person
    run: Callable[[Setup], Figures]


def identify(setup: Setup) -> Figures:
    """Which monitor is which panel, and how each is mounted."""
    monitors = setup.world.monitors()
    try:
        interview = Interview(monitors, panels=setup.settings.stack.stack().count, say=setup.say)
    except ValueError as problem:
        raise InputError(setup.config, "stack.x_m", str(problem)) from None
    shown = None
    interview.ask()
    while not interview.finished:
        if shown != interview.shown or not setup.world.simulated:
            shown = interview.shown
            setup.world.show_card(shown, interview.asked)
        key = setup.poll()
        if key is None:
            setup.world.wait()
        else:
            interview.press(key)
    if not interview.done:
        raise Stopped
    document = read_document(setup.config)
    put_monitors(document, interview.tables)
    save_document(setup.config, document)
    return {"panels": interview.tables}


@dataclass
class Dial:
    """A number that arrows change."""

    name: str
    value: float
    step: float
    least: float
    most: float
    show: Callable[[float], str]

    unknown: float | None = None  # the value to begin with, where 0 says that nothing is known

    def turn(self, direction: int) -> None:
        if self.unknown is not None and (self.value == 0 or self.value + direction * self.step < self.least):
            self.value = self.unknown if direction > 0 else 0.0
            return
        self.value = min(max(self.value + direction * self.step, self.least), self.most)


def geometry(setup: Setup) -> Figures:
    """Size of the panels, their gap, and where viewers stand: about; registration finds the gap exactly."""
    settings = setup.settings
    stack, calibration = settings.stack, settings.calibration
    gap_m = (stack.x_m[-1] - stack.x_m[0]) / (len(stack.x_m) - 1)

    def mm(value: float) -> str:
        return f"{value * 1e3:.1f} mm"

    dials = [
        Dial("width of a panel's picture", stack.width_m, 0.0001, 0.02, 5.0, mm),
        Dial("its height", stack.height_m, 0.0001, 0.02, 5.0, mm),
        Dial("from panel to panel", gap_m, 0.001, 0.002, 0.5, mm),
        Dial("nearest viewer", calibration.viewing_m[0], 0.05, 0.2, 5.0, lambda v: f"{v:.2f} m"),
        Dial("farthest viewer", calibration.viewing_m[1], 0.05, 0.25, 8.0, lambda v: f"{v:.2f} m"),
        Dial(
            "the eye separation of who will calibrate, if it is known (an optician's PD)",
            calibration.ipd_m,
            0.0005,
            0.05,
            0.08,
            lambda v: mm(v) if v else "not known",
            unknown=IPD_M,
        ),
    ]
    chosen, coarse = 0, 1  # which dial; how many of its steps at once
    while True:
        setup.ask(
            f"{dials[chosen].name}: {dials[chosen].show(dials[chosen].value)}",
            "left, right: change; f, c: finer, coarser; up, down: another number; Enter: all are right; q: stop",
        )
        key = setup.key()
        if key is Key.ACCEPT:
            break
        if key is Key.QUIT:
            raise Stopped
        if key in (Key.UP, Key.DOWN):
            chosen = (chosen + (1 if key is Key.DOWN else -1)) % len(dials)
        elif key in (Key.FINER, Key.COARSER):
            coarse = min(coarse * 10, 100) if key is Key.COARSER else max(coarse // 10, 1)
        elif key in (Key.LEFT, Key.RIGHT):
            for _ in range(coarse):
                dials[chosen].turn(1 if key is Key.RIGHT else -1)
    width_m, height_m, found_m, near_m, far_m, ipd_m = (round(dial.value, 5) for dial in dials)
    document = read_document(setup.config)
    values: dict[str, Any] = {"width_m": width_m, "height_m": height_m}
    if abs(found_m - gap_m) > 1e-6:  # else distances that were measured stay as they are
        middle = (len(stack.x_m) - 1) / 2
        values["x_m"] = [round((index - middle) * found_m, 6) for index in range(len(stack.x_m))]
    put(document, "stack", values)
    put(
        document,
        "calibration",
        {"viewing_m": [near_m, far_m]} | ({"ipd_m": ipd_m} if ipd_m != calibration.ipd_m else {}),
    )
    save_document(setup.config, document)
    return {"width_m": width_m, "height_m": height_m, "gap_m": found_m, "viewing_m": [near_m, far_m]}


def registration(setup: Setup) -> Figures:
    """Where the panels truly are, from photographs of the boards."""
    settings = setup.settings
    stack = settings.stack.stack()
    seen, source = setup.world.photographs(settings, poll=setup.poll, say=setup.say)
    setup.say("finding the panels ...")
    summary, text = register_seen(
        seen, source, setup.out / "registration", settings, stack, even=wants_even(settings, stack),
        model=settings.model.name, config=_made(setup.config),
    )  # fmt: skip
    setup.say(text)
    return {
        "psnr_db": summary["psnr_db"],
        "eye_error_mm": summary["eye_error_mm"],
        "gap_mm": [float(gap) * 1e3 for gap in summary["gap_m"]],
        "used": summary["used"],
        "notes": summary["notes"],
    }


def _made(config: Path) -> Path:
    """A configuration that is there: an empty one where there was none."""
    if not config.exists():
        save_document(config, read_document(config))
    return config


def grey(setup: Setup) -> Figures:
    """What each panel makes of a grey, from photographs of its chart; a panel at a time, each kept at once."""
    stack = setup.settings.stack.stack()
    known = [bool(panel.lut) for panel in setup.settings.output.panels] or [False] * stack.count
    residual: dict[int, float] = {}
    number, problem = 0, ""
    while number < stack.count:
        state = "has a curve" if known[number] else "has no curve yet"
        setup.ask(
            f"panel {number} {state}", "Enter: measure it; n: leave it; u: the panel before; q: stop", before=problem
        )
        problem = ""
        key = setup.key()
        if key is Key.QUIT:
            raise Stopped
        if key in (Key.UNDO, Key.PREVIOUS, Key.LEFT):
            number = max(0, number - 1)
        elif key in (Key.NEXT, Key.RIGHT):
            number += 1
        elif key is Key.ACCEPT:
            try:
                pictures = setup.world.grey_photographs(setup.settings, number, poll=setup.poll, say=setup.say)
                measured = pictures_series(pictures, stack, panel=number, source="photographs")
                curves = fit_series(measured, "photographs")
            except InputError as error:
                problem = f"it did not work: {error}"
                continue
            path = (setup.out / "grey" / f"panel-{number}.csv").resolve()
            write_lut(path, measured, curves)
            document = read_document(setup.config)
            put_lut(document, number, str(path), panels=stack.count)
            save_document(setup.config, document)
            residual[number], known[number] = max(curve.residual for curve in curves), True
            setup.say(
                f"panel {number}: taken, {100 * residual[number]:.2f}% of the range off, gamma {curves[1].gamma:.2f}"
            )
            number += 1
    if not any(known):
        setup.say("no panel has a curve: gammas stay as they are configured")
        raise Stopped
    figures: Figures = {"panels": [n for n, has in enumerate(known) if has], "residual": residual}
    return figures | grey_worth(setup.settings)


def sensor(setup: Setup) -> Figures:
    """Which depth sensor sees the viewer; tried at once."""
    names = [name for name in driver_names() if name not in ("replay", "fixed")]
    settings = setup.settings
    if setup.world.simulated:
        names = ["replay"]
    chosen, problem = names.index(settings.sensor.driver) if settings.sensor.driver in names else 0, ""
    while True:
        setup.ask(f"depth sensor: {names[chosen]}", "up, down: another; Enter: try it; q: stop", before=problem)
        problem = ""
        key = setup.key()
        if key is Key.QUIT:
            raise Stopped
        if key in (Key.UP, Key.DOWN):
            chosen = (chosen + (1 if key is Key.DOWN else -1)) % len(names)
        if key is not Key.ACCEPT:
            continue
        update: dict[str, Any] = {"driver": names[chosen]}
        if settings.sensor.driver != names[chosen]:
            update["source"] = ""
        tried = settings.model_copy(update={"sensor": settings.sensor.model_copy(update=update)})
        try:
            name = setup.world.open_sensor(tried)
            break
        except InputError as error:
            problem = f"it does not work: {error}"
    document = read_document(setup.config)
    put(document, "sensor", update)
    save_document(setup.config, document)
    return {"sensor": name}


def calibration(setup: Setup) -> Figures:
    """Where the sensor stands: a person goes from viewpoint to viewpoint."""
    settings = setup.settings
    setup.say(f"sensor: {setup.world.open_sensor(settings)}")
    pairs_path, target = setup.out / "pairs.csv", setup.out / "calibration.toml"
    chart = setup.world.chart(settings)
    try:
        walk = Walk(
            PairsFile(pairs_path), grid(settings.calibration), again=False, window_s=0.5, max_spread_m=0.010,
            say=setup.say, chart=chart,
        )  # fmt: skip
        walk.begin()
        while not walk.finished:
            # Half a second of samples between two keys: what a person's hand leaves too.
            for _ in range(16 if setup.world.simulated else 1):
                sample = setup.world.sample(walk.current)
                if sample is not None:
                    walk.see(sample.capture_ns, sample.eyes, serial=sample.serial)
            if chart is not None:
                chart.again()
            key = setup.poll()
            if key is None:
                setup.world.wait()
            walk.press(key)
    finally:
        if chart is not None:
            chart.close()
    count = walk.summary()["pairs"]
    if count < LEAST_PAIRS:
        setup.say(f"{count} pairs are kept in {pairs_path}; at least {LEAST_PAIRS} are needed")
        raise Stopped
    summary, text = solve_file(
        pairs_path, target, method="", settings=settings, serial="", sensor_unit_m=1.0, stack_unit_m=1.0,
        known_scale=1.0,
    )  # fmt: skip
    setup.say(text)
    document = read_document(_made(setup.config))
    put(document, "calibration", {"file": str(target.resolve())})
    save_document(setup.config, document)

    return {
        "eye_error_mm": summary["eye_error_mm"],
        "expected_db": calibration_worth(setup.settings, eye_error_m=summary["eye_error_mm"] / 1e3),
        "rms_mm": summary["rms_mm"],
        "pairs": summary["pairs"],
        "warnings": summary["warnings"],
    }


def service(setup: Setup) -> Figures:
    """A folder with all that the service reads, and the commands that install it: they ask for another's rights."""
    files = gather(setup.config, setup.out / "service")
    folder = (setup.out / "service").resolve()
    commands = [
        f"sudo install -D -m 644 -t {SERVICE_FOLDER} {folder}/*",
        "sudo systemctl enable --now phasestack",
    ]
    setup.say("the service reads its own copy of all this; it is installed by\n  " + "\n  ".join(commands))
    return {"files": files, "commands": commands}


STEPS = (
    Step("identify", "Which monitor is which panel", "each panel in turn shows a card; you say what you see", identify),
    Step("geometry", "Sizes and distances", "how large the panels are, about how far apart, where viewers stand",
         geometry),
    Step("registration", "Where the panels truly are", "a dozen photographs of the boards, by hand", registration),
    Step("grey", "What each panel makes of a grey", "two photographs of a chart, for each panel", grey),
    Step("sensor", "The depth sensor", "which one sees the viewer's eyes", sensor),
    Step("calibration", "Where the sensor stands", "you stand where lines fuse, and press Enter: 27 places, or 9 "
         "(q: enough)", calibration),
    Step("service", "At every start", "what the service reads, gathered in a folder, and how it is installed", service),
)  # fmt: skip
