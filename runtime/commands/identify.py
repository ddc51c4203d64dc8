"""`phasestack identify`: shows each panel its own name and which way is up."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from runtime.config import Settings
    from runtime.panels.base import PanelSink
    from runtime.panels.monitors import Monitor
    from runtime.records import U8, PanelFrame


def identify(
    config: Annotated[Path | None, typer.Option(help="configuration; without one, every monitor is shown")] = None,
    seconds: Annotated[float, typer.Option(help="how long; 0: until Ctrl-C", min=0)] = 0.0,
    out: Annotated[
        Path | None, typer.Option(help="write what each monitor would be sent as PNG; needs no screen")
    ] = None,
) -> None:
    """Show every panel its index, its monitor, an arrow that should point up, colour bars and its edges.

    With panels in the configuration they are bound, turned, mirrored and registered as they will be when it runs.
    Without any, every monitor tells how to name it in the configuration.

    Exits with 75 where the X server dies.

    Example: phasestack identify --config phasestack.toml --seconds 20
    """
    from runtime.config import load_settings

    settings = load_settings(config)
    if out is not None:
        _write(settings, out)
    else:
        _show(settings, seconds)


def _cards(settings: Settings, monitors: tuple[Monitor, ...] | None) -> list[U8]:
    from runtime.panels.card import identity_card
    from runtime.panels.registry import panel_settings

    stack = settings.stack.stack()
    cards = []
    for index, panel in enumerate(panel_settings(settings.output, stack.count)):
        place = {0: "rear", stack.count - 1: "front"}.get(index, "between")
        lines = [f"{place}, {index + 1} of {stack.count}, at x = {stack.x_m[index] * 100:+.1f} cm"]
        if monitors is not None:
            lines += str(monitors[index]).replace(" (", "\n(").splitlines()
        lines.append(f"mounted at {panel.rotation_deg} degrees, mirroring {panel.mirror}")
        cards.append(identity_card(stack.width_px, stack.height_px, title=f"PANEL {index}", lines=lines))
    return cards


def _write(settings: Settings, out: Path) -> None:
    import numpy as np

    from runtime.clock import MonotonicClock
    from runtime.panels.offscreen import OffscreenPanels
    from runtime.panels.registry import panel_settings
    from runtime.records import PanelFrame
    from runtime.support.artifacts import OutputFolder, write_png
    from runtime.support.gl import offscreen_context

    stack = settings.stack.stack()
    panels = OffscreenPanels(
        offscreen_context(),
        clock=MonotonicClock(),
        width_px=stack.width_px,
        height_px=stack.height_px,
        panels=panel_settings(settings.output, stack.count),
    )
    with OutputFolder(out) as folder:
        panels.present(PanelFrame(0, np.stack(_cards(settings, None)), 0))
        for index, picture in enumerate(panels.read_back()):
            write_png(folder.staging / f"monitor-{index}.png", picture)
    typer.echo(f"{stack.count} pictures in {out}")


def _show(settings: Settings, seconds: float) -> None:
    import numpy as np

    from runtime.errors import InputError, PanelLost
    from runtime.records import PanelFrame

    try:
        panels, cards = _bound(settings) if settings.output.panels else _every_monitor()
    except PanelLost as error:
        raise InputError("output", "panels", str(error)) from None
    try:
        _hold(panels, PanelFrame(0, np.stack(cards), 0), seconds)
    finally:
        panels.close()


def _bound(settings: Settings) -> tuple[PanelSink, list[U8]]:
    from runtime.clock import MonotonicClock
    from runtime.panels.registry import panel_settings
    from runtime.panels.window import WindowPanels
    from runtime.support.gl import offscreen_context

    kind = "span" if settings.output.kind == "span" else "windows"
    output = settings.output.model_copy(update={"kind": kind})
    stack = settings.stack.stack()
    panels = WindowPanels(output, panel_settings(output, stack.count), stack, MonotonicClock(), offscreen_context())
    for index, monitor in enumerate(panels.monitors):
        typer.echo(f"panel {index}: {monitor}")
    return panels, _cards(settings, panels.monitors)


def _every_monitor() -> tuple[PanelSink, list[U8]]:
    from runtime.clock import MonotonicClock
    from runtime.config import OutputSettings, PanelSettings
    from runtime.optics.stack import PanelStack
    from runtime.panels.card import identity_card
    from runtime.panels.display import connected_monitors
    from runtime.panels.window import WindowPanels
    from runtime.support.gl import offscreen_context

    monitors = connected_monitors()
    width, height = max(m.width_px for m in monitors), max(m.height_px for m in monitors)
    bound = tuple(PanelSettings(connector=monitor.connector) for monitor in monitors)
    # Only for this picture: monitors of any shape, each filled.
    stack = PanelStack(1.0, 1.0, tuple(0.01 * index for index in range(len(monitors))), width, height)
    output = OutputSettings(kind="windows", panels=bound)
    panels = WindowPanels(output, bound, stack, MonotonicClock(), offscreen_context(), any_shape=True)
    cards = []
    for index, monitor in enumerate(monitors):
        name = f'edid_serial = "{monitor.serial}"' if monitor.serial else f'connector = "{monitor.connector}"'
        typer.echo(f"{monitor}: [[output.panels]] {name}")
        lines = [monitor.model or "(no name in its EDID)", f"{monitor.width_px} x {monitor.height_px}",
                 "in the configuration:", "[[output.panels]]", name]  # fmt: skip
        cards.append(identity_card(width, height, title=monitor.connector, lines=lines))
        if not monitor.serial:
            typer.echo(f"  {monitor.connector} has no EDID serial: monitor {index} is known by its connector only")
    return panels, cards


def _hold(panels: PanelSink, frame: PanelFrame, seconds: float) -> None:
    """Show a frame again and again, so that closed windows and lost monitors come back."""
    import time

    from runtime.errors import PanelLost

    deadline = time.monotonic() + seconds if seconds else float("inf")
    lost = ""
    try:
        while time.monotonic() < deadline:
            try:
                panels.present(frame)
                lost = ""
            except PanelLost as error:
                if str(error) != lost:
                    lost = str(error)
                    typer.echo(f"lost: {lost}", err=True)
            time.sleep(0.1)
    except KeyboardInterrupt:
        return
