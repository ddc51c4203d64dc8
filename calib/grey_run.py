"""`calibrate panels grey`: a measured or typed series to a LUT."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import typer

from calib.bare_panels import BarePanels
from calib.charts import alone
from calib.grey import CHANNELS, GreyCurve, Series, fit_series, lut_text, read_series
from calib.grey_chart import Unusable, grey_chart, histograms, measure
from calib.keys import Key, TerminalKeys, first_of
from calib.panel_figures import grey_figure
from calib.photo_run import photograph_files, read_photograph
from runtime.clock import MonotonicClock
from runtime.config import Settings
from runtime.errors import InputError
from runtime.optics.stack import PanelStack
from runtime.panels.registry import open_panels, panel_settings
from runtime.records import F64, U8, PanelFrame
from runtime.support.artifacts import OutputFolder, write_bytes, write_text
from runtime.support.gl import offscreen_context


def fit_lut(
    out: Path,
    series: Path | None,
    *,
    settings: Settings,
    stack: PanelStack,
    levels: int,
    panel: int,
    photos: Path | None = None,
) -> tuple[dict[str, Any], str]:
    """Write the LUT and its plot. Raises InputError."""
    source = series or photos or "typed"
    if photos is not None:
        measured = photographed_series(photos, stack, panel=panel)
    else:
        measured = read_series(series) if series else typed_series(settings, stack, levels=levels, panel=panel)
    curves = fit_series(measured, source)
    write_lut(out, measured, curves)
    summary = {
        "file": str(out),
        "plot": str(out.with_suffix(".png")),
        "channels": {name: asdict(curve) for name, curve in zip(CHANNELS, curves, strict=True)},
    }
    lines = [
        f"{name}: smooth in {'intensity' if curve.of_intensity else 'phase'}, gamma {curve.gamma:.3f}, contrast "
        f"{1 + curve.span / max(curve.dark, 1e-9 * curve.span):.4g}, residual {100 * curve.residual:.2f}% of the range"
        for name, curve in zip(CHANNELS, curves, strict=True)
    ]
    return summary, "\n".join([*lines, f"{out}"])


def write_lut(out: Path, measured: Series, curves: tuple[GreyCurve, GreyCurve, GreyCurve]) -> None:
    """A panel's LUT, and its plot beside it."""
    with OutputFolder(out.parent) as folder:
        write_text(folder.staging / out.name, lut_text(curves))
        write_bytes(folder.staging / f"{out.stem}.png", grey_figure(measured, curves))


def photographed_series(photos: Path, stack: PanelStack, *, panel: int) -> Series:
    """Relative luminances from photographs of a panel's grey chart. Raises InputError, naming the photograph."""
    pictures = ((str(path), read_photograph(path)) for path in photograph_files(photos))
    return pictures_series(pictures, stack, panel=panel, source=str(photos))


def pictures_series(pictures: Iterable[tuple[str, U8]], stack: PanelStack, *, panel: int, source: str) -> Series:
    """The same from named grey photographs (h, w). Raises InputError."""
    found = []
    for name, picture in pictures:
        try:
            found.append(histograms(picture, stack, panel))
        except Unusable as problem:
            raise InputError(name, "", str(problem)) from None
    try:
        return measure(found, stack, panel)
    except Unusable as problem:
        raise InputError(source, "greys", str(problem)) from None


def show_grey_chart(settings: Settings, stack: PanelStack, *, panel: int) -> None:
    """A panel's grey chart on the bare panel, the others clear, until Enter or q. Raises InputError, PanelLost."""
    keys = TerminalKeys()
    panels = BarePanels(settings, stack, grey_curve=False)
    poll = first_of(keys.poll, panels.keys.poll)
    try:
        if not panels.seen:
            typer.echo("warning: output.kind is offscreen: nobody sees this chart", err=True)
        typer.echo(f"the grey chart of panel {panel} is shown (Enter or q: done)", err=True)
        panels.show(alone(grey_chart(stack, panel), stack, index=panel))
        while poll() not in (Key.ACCEPT, Key.QUIT):
            panels.again()
    finally:
        panels.close()
        keys.close()


def typed_series(settings: Settings, stack: PanelStack, *, levels: int, panel: int) -> Series:
    """Luminances that a person reads off a photometer; each grey is shown on the panel where one is given."""
    show, close = _screen(settings, stack, panel) if panel >= 0 else (lambda grey: None, lambda: None)
    try:
        return ask_series(
            np.linspace(0.0, 1.0, levels).tolist(), show=show, ask=lambda text: typer.prompt(text, type=float, err=True)
        )
    finally:
        close()


def ask_series(greys: Sequence[float], *, show: Callable[[float], None], ask: Callable[[str], float]) -> Series:
    """A series by asking for every grey's luminance. Raises InputError for a negative or infinite one."""
    values: list[float] = []
    for grey in greys:
        show(grey)
        value = ask(f"luminance at grey {round(255 * grey)} of 255")
        if not 0.0 <= value < float("inf"):
            raise InputError("typed", f"grey {round(255 * grey)}", "must be a luminance, 0 or more")
        values.append(value)
    # What is shown is eight bits: the grey that was really there.
    shown: F64 = np.rint(255 * np.array(greys)) / 255
    return Series(shown, np.repeat(np.array(values)[:, None], 3, axis=1))


def _screen(settings: Settings, stack: PanelStack, panel: int) -> tuple[Callable[[float], None], Callable[[], None]]:
    # The bare panel is measured: no curve, whatever is configured.
    bare = tuple(
        item.model_copy(update={"lut": "", "gamma": 1.0}) for item in panel_settings(settings.output, stack.count)
    )
    sink = open_panels(
        settings.output.model_copy(update={"panels": bare}), stack, MonotonicClock(), offscreen_context()
    )
    layers = np.zeros((stack.count, stack.height_px, stack.width_px, 4), np.uint8)
    layers[..., 3] = 255
    number = 0

    def show(grey: float) -> None:
        nonlocal number
        number += 1
        layers[panel, ..., :3] = round(255 * grey)
        sink.present(PanelFrame(number, layers, number))

    return show, sink.close
