"""`calibrate panels charts|vernier|fit`: from verniers to the homographies in the configuration."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit
import typer

from calib.config_file import put_homographies, read_document, save_document
from calib.keys import Key, TerminalKeys, WindowKeys, first_of
from calib.panel_figures import registration_figure
from calib.registration import Setting, StackRegistration, parts, register
from calib.vernier import STEPS_PX, Nudging, chart, nominal, read_settings, resumed, write_settings
from runtime.clock import NS_PER_MS, MonotonicClock
from runtime.config import Settings
from runtime.errors import InputError
from runtime.optics.stack import PanelStack
from runtime.panels.registry import open_panels, panel_settings
from runtime.records import F64, U8, PanelFrame
from runtime.report.page import Figure, Page, in_columns, section_of
from runtime.support import foreign
from runtime.support.artifacts import OutputFolder, write_png
from runtime.support.gl import offscreen_context

POLL_NS = 30 * NS_PER_MS
SHOW_AGAIN_POLLS = 5


def asked_settings(stack: PanelStack, *, eye_m: Sequence[float], reference: int) -> list[Setting]:
    """Every vernier for an eye. Raises InputError where some panel cannot be seen over the reference."""
    try:
        return nominal(eye_m, stack, reference=reference)
    except ValueError as problem:
        raise InputError("calibrate panels", "--eye", str(problem)) from None


def write_vernier_charts(out: Path, stack: PanelStack, *, eye_m: Sequence[float], reference: int) -> dict[str, Any]:
    """PNGs `vernier-R-P-layer-N.png` of the verniers of panel P against reference R."""
    asked = asked_settings(stack, eye_m=eye_m, reference=reference)
    files = []
    with OutputFolder(out) as folder:
        for panel in sorted({s.panel for s in asked}):
            layers = chart(stack, [s for s in asked if s.panel == panel])
            for index in (reference, panel):
                files.append(f"vernier-{reference}-{panel}-layer-{index}.png")
                write_png(folder.staging / files[-1], layers[index])
    return {"out": str(out), "files": files, "eye_m": list(eye_m)}


def nudge_verniers(
    out: Path, settings: Settings, stack: PanelStack, *, eye_m: Sequence[float], reference: int
) -> dict[str, Any]:
    """Let a person set the verniers on the panels. Raises InputError, MissingPart, PanelLost."""
    asked = asked_settings(stack, eye_m=eye_m, reference=reference)
    nudging = resumed(asked, read_settings(out, stack) if foreign.is_there(out) else [])
    # Verniers measure the bare panels: a registration that is already configured would be measured away.
    bare = tuple(
        panel.model_copy(update={"homography": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))})
        for panel in panel_settings(settings.output, stack.count)
    )
    output = settings.output.model_copy(update={"panels": bare})
    context = offscreen_context()
    keys = TerminalKeys()
    clock = MonotonicClock()
    try:
        sink = open_panels(output, stack, clock, context)
        if output.kind == "offscreen":
            typer.echo("warning: output.kind is offscreen: nobody sees these verniers", err=True)
        number = 0

        def present(layers: U8) -> None:
            nonlocal number
            number += 1
            sink.present(PanelFrame(number, layers, number))

        if nudging.finished:
            typer.echo(f"{out}: every vernier has its setting already", err=True)
        try:
            found = nudge(
                nudging,
                stack,
                poll=first_of(keys.poll, WindowKeys(sink).poll),
                present=present,
                wait=lambda: clock.sleep_until_ns(clock.now_ns() + POLL_NS),
                keep=lambda settings: write_settings(out, settings),
                say=lambda text: typer.echo(text, err=True),
            )
        finally:
            sink.close()
    finally:
        keys.close()
    return {"file": str(out), "settings": len(found), "asked": len(asked), "eye_m": list(eye_m)}


def nudge(
    nudging: Nudging,
    stack: PanelStack,
    *,
    poll: Callable[[], Key | None],
    present: Callable[[U8], None],
    wait: Callable[[], None],
    keep: Callable[[list[Setting]], None],
    say: Callable[[str], None],
) -> list[Setting]:
    """Show, move, take, until the last vernier or q. Every setting is kept as soon as it is taken."""
    shown, layers, idle = None, None, 0
    while not nudging.finished:
        if shown != nudging.current or layers is None:
            if shown is None or shown.reference_px != nudging.current.reference_px:
                say(f"panel {nudging.current.panel}, vernier {nudging.index + 1} of {len(nudging.asked)}")
            shown = nudging.current
            layers, idle = chart(stack, [shown]), SHOW_AGAIN_POLLS
        if idle >= SHOW_AGAIN_POLLS:  # again and again: it keeps the windows alive
            present(layers)
            idle = 0
        key = poll()
        if key is None:
            idle += 1
            wait()
            continue
        if nudging.press(key):
            keep(nudging.done)
        elif key in (Key.FINER, Key.COARSER):
            say(f"steps of {STEPS_PX[nudging.step]} pixels")
    return nudging.done


def fit_registration(
    vernier: Path, out: Path, settings: Settings, stack: PanelStack, *, reference: int, config: Path | None
) -> tuple[dict[str, Any], str]:
    """Fit, report, and put the homographies into `config` where one is given. Raises InputError."""
    found = read_settings(vernier, stack)
    try:
        registration = register(found, stack, reference=reference)
    except ValueError as problem:
        raise InputError(vernier, "", str(problem)) from None
    if config is not None:
        check_tables(settings, stack, config)
    summary = registration_summary(registration, stack) | {"source": str(vernier)}
    rows = registration_rows(registration, stack)
    figure = Figure(
        "registration",
        registration_figure(registration, stack),
        "Displacement of each panel from its ideal place, enlarged; numbers: pixels at the corners",
    )
    page = Page(
        "Registration of the panels",
        f"{len(found)} vernier settings, panel {reference} as the reference; one setting is exact to "
        f"{registration.sigma_px:.3f} px.",
        [replace(section_of("Panels", rows), figures=[figure])],
        notes=summary["warnings"],
    )
    page.write(out, record="registration.json", data=summary, texts={"panels.toml": panels_text(registration)})
    if config is not None:
        summary["kept_version"] = str(write_homographies(config, registration))
    return summary, in_columns(rows)


def check_tables(settings: Settings, stack: PanelStack, config: Path) -> None:
    """Raises InputError where a configuration has another number of panels' tables than panels."""
    if len(settings.output.panels) not in (0, stack.count):
        raise InputError(config, "output.panels", f"has {len(settings.output.panels)} tables for {stack.count} panels")


def registration_summary(registration: StackRegistration, stack: PanelStack) -> dict[str, Any]:
    """What `registration.json` holds."""
    panels = []
    for index, panel in enumerate(registration.panels):
        described = asdict(parts(panel.true_from_ideal, width_px=stack.width_px, height_px=stack.height_px))
        panels.append(
            described
            | {
                "panel": index,
                "homography": panel.true_from_ideal,
                "corners_px": panel.corners_px,
                "setting_sigma_px": panel.setting_sigma_px,
                "viewpoint_sigma_px": panel.viewpoint_sigma_px,
                "corner_covariance_px2": panel.setting_covariance,
                "settings": panel.settings,
            }
        )
    distance = np.linalg.norm(registration.residual_px, axis=1)
    limit = 4 * max(registration.sigma_px, 0.05)
    warnings = [
        f"setting {number + 1} is {distance[number]:.2f} px off the fit: set it again"
        for number in np.flatnonzero(distance > limit)
    ]
    return {
        "reference": registration.reference,
        "sigma_px": registration.sigma_px,
        "largest_residual_px": float(distance.max()),
        "panels": panels,
        "warnings": warnings,
    }


def registration_rows(registration: StackRegistration, stack: PanelStack) -> list[list[str]]:
    """The table for people."""
    rows = [["panel", "shift u, v (px)", "rotation (°)", "scale u, v", "keystone (px)", "± settings (px)",
             "± viewpoint (px)"]]  # fmt: skip
    for index, panel in enumerate(registration.panels):
        if index == registration.reference:
            rows.append([str(index), "the reference", "", "", "", "", ""])
            continue
        p = parts(panel.true_from_ideal, width_px=stack.width_px, height_px=stack.height_px)
        rows.append([
            str(index), f"{p.shift_px[0]:+.2f}, {p.shift_px[1]:+.2f}", f"{p.rotation_deg:+.4f}",
            f"{p.scale[0]:.5f}, {p.scale[1]:.5f}", f"{p.keystone_px:.2f}", f"{panel.setting_sigma_px:.3f}",
            f"{panel.viewpoint_sigma_px:.2f}",
        ])  # fmt: skip
    return rows


def panels_text(registration: StackRegistration) -> str:
    """`[[output.panels]]` tables with the homographies, to paste into a configuration."""
    return panels_document(np.stack([panel.true_from_ideal for panel in registration.panels]))


def panels_document(matrices: F64, *, stack: Mapping[str, Any] | None = None) -> str:
    """The same from (N, 3, 3) homographies, and what is to be put into `[stack]`."""
    document = tomlkit.document()
    if stack is not None:
        document["stack"] = dict(stack)
    tables = tomlkit.aot()
    for matrix in matrices:
        table = tomlkit.table()
        table["homography"] = matrix.tolist()
        tables.append(table)
    document["output"] = {"panels": tables}
    return tomlkit.dumps(document)


def write_homographies(config: Path, registration: StackRegistration) -> Path | None:
    """Put the homographies into a configuration, its comments kept; answers where the old one is kept.

    The new text is checked as a configuration before it takes the old one's place. Raises InputError.
    """
    document = read_document(config)
    put_homographies(document, np.stack([panel.true_from_ideal for panel in registration.panels]))
    document.get("stack", {}).pop("tilt", None)  # of an earlier registration by photographs: verniers tell none
    return save_document(config, document)
