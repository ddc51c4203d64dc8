"""`phasestack doctor`: check everything needed by the configuration, and suggest how to fix problems.

Each check is a small function that takes the settings and yields table rows.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from runtime.errors import PhasestackError
from runtime.support.extras import missing_extra
from runtime.support.options import JsonOption
from runtime.support.plugins import is_plugin, plugin_class

if TYPE_CHECKING:
    from runtime.config import Settings
    from runtime.model.base import Predictor
    from runtime.model.device import SolverBackend

Verdict = Literal["ok", "warn", "fail", "skip"]
CHECK_SENSOR_FOR_S = 3.0  # how long to wait for a sensor's first sample
SERVICE_CONFIG = Path("/etc/phasestack/phasestack.toml")
SLOW_MS = 150.0  # if a solution takes longer, moving viewers see a worse picture (docs/performance.md)
MEASURED_MS = 2000.0  # if a solution is expected to take longer, it is not timed at full size
SEE_LOG = "see the log: journalctl -u phasestack"
NO_DEVICE = ("replay", "fixed")  # drivers that do not need a device


@dataclass(frozen=True, slots=True)
class Row:
    """The result of one check."""

    name: str
    state: Verdict
    detail: str  # the finding
    remedy: str = ""  # a remedy for the user; or empty


def doctor(
    config: Annotated[Path | None, typer.Option(help="configuration to check (default: built-in settings)")] = None,
    as_service: Annotated[bool, typer.Option("--service", help="check as the systemd service (requires root)")] = False,
    as_json: JsonOption = False,
) -> None:
    """Check the settings, sensor, permissions, OpenGL, monitors, scene, model, calibration and service.

    Anything unusual that still works gives a warning. Exits with 1 if any check fails.

    Example: phasestack doctor --config /etc/phasestack/phasestack.toml

    Example: sudo phasestack doctor --service
    """
    from runtime.config import load_settings

    if as_service:
        _become_service()
        config = config or SERVICE_CONFIG
    rows = examine(load_settings(config))
    failed = sum(row.state == "fail" for row in rows)
    if as_json:
        typer.echo(json.dumps({"ok": not failed, "checks": [asdict(row) for row in rows]}))
    else:
        for row in rows:
            remedy = f"\n      remedy: {row.remedy}" if row.remedy else ""
            typer.echo(f"{row.state:5} {row.name}: {row.detail}{remedy}")
    if failed:
        raise typer.Exit(1)


def _become_service() -> None:
    """Switch to the service's user, groups and environment, but not its sandbox. Raises InputError if not allowed."""
    import grp
    import pwd
    import shlex

    from runtime.daemon.client import unit_properties
    from runtime.errors import InputError

    unit = unit_properties("User", "Group", "SupplementaryGroups", "Environment", "WorkingDirectory", "StateDirectory")
    if not unit:
        raise InputError("doctor", "--service", "phasestack.service is not installed; run systemd/install.sh first")
    try:
        os.setgroups([grp.getgrnam(name).gr_gid for name in unit["SupplementaryGroups"].split()])
        os.setgid(grp.getgrnam(unit["Group"]).gr_gid)
        os.setuid(pwd.getpwnam(unit["User"]).pw_uid)
        os.chdir(unit["WorkingDirectory"])
    except (OSError, KeyError) as error:
        raise InputError(
            "doctor", "--service", f"cannot switch to the service's user ({error}); run this command with sudo"
        ) from None
    os.environ |= dict(entry.partition("=")[::2] for entry in shlex.split(unit["Environment"]))
    os.environ["STATE_DIRECTORY"] = f"/var/lib/{unit['StateDirectory']}"


Check = Callable[["Settings"], Iterator[Row]]


def examine(settings: Settings) -> list[Row]:
    """Run all checks and return the table rows. A check that raises an exception counts as failed."""
    rows: list[Row] = []
    for check in CHECKS:
        name = check.__name__
        try:
            rows += check(settings)
        except PhasestackError as error:
            rows.append(Row(name, "fail", str(error)))
        except Exception as error:
            if missing := missing_extra(error):
                rows.append(Row(name, "fail", str(missing)))
                continue
            rows.append(Row(name, "fail", f"{type(error).__name__}: {error}", "this is a bug; please report it"))
    return rows


def sensor(settings: Settings) -> Iterator[Row]:
    """Check that the configured driver can be opened and delivers samples."""
    from runtime.clock import MonotonicClock
    from runtime.errors import EndOfRecording, SensorLost, SensorTimeout
    from runtime.eyes.calibration import load_calibration
    from runtime.sensor.registry import open_sensor

    if settings.sensor.driver not in NO_DEVICE and (answer := _daemon(settings)):
        eyes = answer.get("eyes_label", "unknown")
        yield Row("sensor", "skip", f"not checked because the running daemon is using the sensor (eyes: {eyes})")
        return
    driver = open_sensor(settings.sensor, MonotonicClock())
    own = is_plugin(settings.sensor.driver)
    what = settings.sensor.driver if own else f"{settings.sensor.driver} ({settings.sensor.source})"
    try:
        driver.open()
        frame = driver.read_newest(CHECK_SENSOR_FOR_S)
    except (SensorLost, SensorTimeout, EndOfRecording) as error:
        remedy = "see docs/sensors.md" if own else "connect the sensor (see the usb rows and docs/planning.md)"
        yield Row("sensor", "fail", f"{what}: {error or 'no sample arrived'}", remedy)
        return
    finally:
        driver.close()
    streams = {"eyes": frame.eyes, "colour": frame.colour, "depth": frame.depth_mm}
    kinds = [name for name, value in streams.items() if value is not None]
    serial = f", serial {driver.serial}" if driver.serial else ""
    yield Row("sensor", "ok", f"{what} delivers {', '.join(kinds) or 'frames without a face'}{serial}")
    calibrated = load_calibration(Path(settings.calibration.file) if settings.calibration.file else None)
    if warning := calibrated.serial_warning(driver.serial):
        yield Row("calibration", "fail", warning, "run `phasestack setup`")


def usb(settings: Settings) -> Iterator[Row]:
    """Check the port speed, permissions and driver of each USB depth camera."""
    from runtime.errors import MissingPart
    from runtime.sensor.usb_devices import find_devices

    driver = settings.sensor.driver
    needed = driver not in (*NO_DEVICE, "usb-camera") and not is_plugin(driver)
    absent: Verdict = "fail" if needed else "skip"
    try:
        devices = find_devices()
    except MissingPart as error:
        yield Row("usb", absent, str(error), "install libusb" if needed else "")
        return
    if not devices:
        remedy = "connect a depth camera; docs/planning.md lists the supported ones" if needed else ""
        yield Row("usb", absent, "no known depth camera is connected", remedy)
    for device in devices:
        problems = device.problems()
        state: Verdict = "ok" if not problems else "fail" if needed else "warn"
        yield Row("usb", state, str(device), "; ".join(problems))


def opengl(settings: Settings) -> Iterator[Row]:
    """Check that OpenGL works without a screen, as needed for content and offscreen panels."""
    from runtime.support.gl import describe, draws_in_software, offscreen_context

    context = offscreen_context()
    try:
        found, software = describe(context), draws_in_software(context)
    finally:
        context.release()
    for node in sorted(Path("/dev/dri").glob("renderD*")):
        if not os.access(node, os.R_OK | os.W_OK):
            yield Row("opengl", "warn", f"this user cannot open {node}", "add the user to the groups video and render")
    bad = software and (settings.output.kind != "offscreen" or settings.model.backend == "gl")
    slow = "software rendering is slow; if this machine has a GPU, install its driver" if software else ""
    yield Row("opengl", "warn" if bad else "ok", f"{found['renderer']}, {found['version']} ({found['vendor']})", slow)


def monitors(settings: Settings) -> Iterator[Row]:
    """Check that every configured panel's monitor is connected."""
    from runtime.errors import InputError, PanelLost
    from runtime.panels.monitors import bind, check_modes, gamma_warning, refresh_difference
    from runtime.panels.registry import panel_settings

    if settings.output.kind == "offscreen":
        yield Row("monitors", "skip", "not checked because output.kind is offscreen")
        return
    from runtime.panels.display import connected_monitors

    remedy = "run `phasestack identify` to show the name of each monitor"
    try:
        there = connected_monitors()
    except PanelLost as error:
        yield Row("monitors", "fail", str(error), "start the X server and set DISPLAY and XAUTHORITY")
        return
    panels = panel_settings(settings.output, len(settings.stack.x_m))
    named = {panel.connector for panel in panels}
    for monitor in there:
        known = monitor.serial or monitor.connector in named
        by_connector = "this monitor reports no EDID serial number; select it by connector instead"
        yield Row("monitor", "ok", str(monitor), "" if known else by_connector)
    try:
        bound = bind(panels, there)
        check_modes(panels, bound, width_px=settings.stack.width_px, height_px=settings.stack.height_px)
    except (InputError, PanelLost) as error:
        yield Row("panels", "fail", str(error), remedy)
        return
    for number, monitor in enumerate(bound):
        yield Row("panels", "ok", f"panel {number} is {monitor}")
    if difference := refresh_difference(bound):
        yield Row("panels", "warn", difference, "set all panels to the same video mode")
    if changed := gamma_warning(bound):
        yield Row("panels", "warn", changed)


def content(settings: Settings) -> Iterator[Row]:
    """Check that the scene exists and can be read."""
    from runtime.content.registry import prepare_content

    prepare_content(settings.content, settings.stack.stack())
    yield Row("content", "ok", settings.content.scene)


def model(settings: Settings) -> Iterator[Row]:
    """Check that the network loads, fits the stack and has its execution provider. Times a solution."""
    import cv2

    from runtime.model.backends import choose
    from runtime.model.predictor import load_predictor
    from runtime.support.gl import offscreen_context

    cv2.setNumThreads(settings.model.threads or -1)
    predictor = load_predictor(settings.model.name, settings.stack.stack(), settings.model)
    name = predictor.facts.name
    with ExitStack() as cleanup:

        def context() -> Any:
            made = offscreen_context()
            cleanup.callback(made.release)
            return made

        choice = choose(settings.model.backend, predictor, context)
        rate = _rate(predictor, choice.backend, settings)
        predictor.close()
    other = settings.model.name not in name and "/" not in settings.model.name
    remedy = f"the network of {settings.model.name} does not fit this stack" if other else ""
    yield Row("model", "warn" if other else "ok", f"{name} on {settings.model.provider}", remedy)
    yield Row("backend", "ok", f"the solver runs on {choice.backend.name}: {choice.why}")
    yield rate


def _rate(predictor: Predictor, backend: SolverBackend, settings: Settings) -> Row:
    """Measure how many full solutions this machine computes per second with the slowest kind of picture."""
    from dataclasses import replace

    from runtime.model.backends import solution_ms

    stack = predictor.stack
    raster = f"{stack.width_px}x{stack.height_px}"
    if not predictor.facts.has_devices:
        return Row("rate", "skip", f"cannot time the model {predictor.facts.name}")
    coarse = replace(stack, width_px=max(64, stack.width_px // 4), height_px=max(64, stack.height_px // 4))
    took_ms, how = 16 * solution_ms(predictor, coarse, backend, runs=3), f"estimated from {coarse.width_px} columns"
    if took_ms < MEASURED_MS:
        took_ms, how = solution_ms(predictor, stack, backend, runs=1), "measured"
    detail = f"{raster}: {took_ms:.0f} ms per full solution, or {1000 / took_ms:.1f} per second ({how})"
    if took_ms < SLOW_MS:
        return Row("rate", "ok", detail)
    coarser = "moving viewers will see coarser pictures; " if settings.model.effort == "auto" else ""
    sharper = "use a GPU, the model `fast` or panels with fewer pixels (see docs/planning.md)"
    return Row("rate", "warn", detail, coarser + sharper)


def calibration(settings: Settings) -> Iterator[Row]:
    """Check that the calibration is a similarity and, with a real sensor, not the demo's calibration."""
    from runtime.eyes.calibration import load_calibration
    from runtime.sensor.base import Sensor

    if not settings.calibration.file:
        driver = settings.sensor.driver
        if is_plugin(driver) and plugin_class(driver, Sensor, field="sensor.driver").capabilities.in_stack_frame:
            yield Row("calibration", "ok", "not needed because this sensor delivers eye positions in the stack frame")
            return
        detail = "calibration.file is not set, so the demo calibration is in use"
        remedy = "run `phasestack calibrate capture` and `calibrate solve`, then set calibration.file"
        if driver in NO_DEVICE:
            yield Row("calibration", "ok", detail)
        else:
            yield Row("calibration", "fail", detail, remedy)
        return
    found = load_calibration(Path(settings.calibration.file))
    fit = f", residual {found.file.residuals.rms_m * 1000:.1f} mm" if found.file.residuals else ""
    yield Row("calibration", "ok", f"{found.source}: scale {found.scale:.4f}{fit}")
    for warning in found.warnings:
        yield Row("calibration", "warn", warning, "calibrate again")


def service(settings: Settings) -> Iterator[Row]:
    """Check that the daemon, if one is running, is healthy."""
    from runtime.daemon.client import HUNG_AFTER_S

    answer = _daemon(settings)
    if answer is None:
        yield Row("service", "skip", f"no daemon answers at {settings.service.socket}")
        return
    state = str(answer.get("state", "unknown"))
    age_s = float(answer.get("turn_age_s", 0.0))
    if age_s > HUNG_AFTER_S:
        yield Row("service", "fail", f"the display loop has not responded for {age_s:.0f} s", SEE_LOG)
    elif state.startswith("degraded"):
        yield Row("service", "fail", f"{state} ({answer.get('reason', '')})", SEE_LOG)
    else:
        yield Row("service", "ok", f"{state} ({answer.get('reason', '')}), pid {answer.get('pid')}")
    for process in answer.get("processes", ()):
        found = "is being restarted"
        if process.get("pid") is not None:
            found = f"pid {process['pid']}, {process['memory_mib']} MiB, {process['cpu_s']} s of processor time"
        detail, restarts = f"{process['role']}: {found}", process.get("restarts", 0)
        if restarts:
            yield Row("processes", "warn", f"{detail}, restarted {restarts} times", SEE_LOG)
        else:
            yield Row("processes", "ok", detail)


def _daemon(settings: Settings) -> dict[str, Any] | None:
    """Return the running daemon's status, or None if no daemon is running."""
    from runtime.daemon.client import NotRunning, ask, candidates

    try:
        return ask(candidates(settings.service.socket), {"command": "status"}, timeout_s=2.0)
    except NotRunning:
        return None


CHECKS: tuple[Check, ...] = (opengl, monitors, usb, sensor, calibration, content, model, service)
