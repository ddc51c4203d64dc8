"""`phasestack identify`: shows each panel its own name and which way is up."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from runtime.support.options import number

if TYPE_CHECKING:
    from collections.abc import Callable

    from calib.keys import Key
    from runtime.config import Settings
    from runtime.panels.base import PanelSink
    from runtime.panels.monitors import Monitor
    from runtime.records import U8


def identify(
    config: Annotated[Path | None, typer.Option(help="configuration; without one, every monitor is shown")] = None,
    panel: Annotated[int, typer.Option(help="show this panel (or monitor) alone; -1: one after the other")] = -1,
    all_at_once: Annotated[bool, typer.Option("--all", help="all at once: for panels that lie side by side")] = False,
    ask: Annotated[bool, typer.Option("--ask", help="ask which is which, and write the answers into --config")] = False,
    seconds: Annotated[float, number(0, 86_400, "s", help="how long; 0: until q")] = 0.0,
    out: Annotated[
        Path | None, typer.Option(help="write what each monitor would be sent as PNG; needs no screen")
    ] = None,
) -> None:
    """Show a panel its index, its monitor, an arrow that should point up, colour bars and its edges.

    Panels stand behind one another: one shows its card, the others are clear; Enter or n goes to the next, p back, q
    ends. With panels in the configuration they are bound, turned, mirrored and registered as they will be when it
    runs. Without any, every monitor tells how to name it in the configuration; or --ask goes through the panels from
    rear to front, asks which monitor each is and how it is mounted, and writes the configuration's tables.

    Exits with 75 where the X server dies.

    Example: phasestack identify --config phasestack.toml --ask
    """
    from runtime.config import load_settings
    from runtime.errors import InputError
    from runtime.support.foreign import is_there

    if ask and config is None:
        raise InputError("identify", "--ask", "needs --config (it is made where it is not there)")
    settings = load_settings(config if config is None or not ask or is_there(config) else None)
    if out is not None:
        _write(settings, out, panel)
    elif ask:
        assert config is not None
        _ask(settings, config)
    else:
        _show(settings, seconds, panel, all_at_once)


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


def _write(settings: Settings, out: Path, panel: int) -> None:
    from runtime.clock import MonotonicClock
    from runtime.panels.offscreen import OffscreenPanels
    from runtime.panels.registry import panel_settings
    from runtime.records import PanelFrame
    from runtime.support.artifacts import OutputFolder, write_png
    from runtime.support.gl import offscreen_context

    stack = settings.stack.stack()
    cards = _cards(settings, None)
    _check_panel(panel, len(cards))
    panels = OffscreenPanels(
        offscreen_context(),
        clock=MonotonicClock(),
        width_px=stack.width_px,
        height_px=stack.height_px,
        panels=panel_settings(settings.output, stack.count),
    )
    with OutputFolder(out) as folder:
        panels.present(PanelFrame(0, alone(cards, panel), 0))
        for index, picture in enumerate(panels.read_back()):
            write_png(folder.staging / f"monitor-{index}.png", picture)
    typer.echo(f"{stack.count} pictures in {out}")


def alone(cards: list[U8], index: int) -> U8:
    """(N, H, W, 4) layers with one card, the other panels clear; -1: all of them."""
    import numpy as np

    layers = np.stack(cards)
    for other in range(len(cards)):
        if index not in (-1, other):
            layers[other, ..., :3] = 0
    return layers


def _check_panel(panel: int, count: int) -> None:
    from runtime.errors import InputError

    if not -1 <= panel < count:
        raise InputError("identify", "--panel", f"must be 0 to {count - 1}")


def _show(settings: Settings, seconds: float, panel: int, all_at_once: bool) -> None:
    from calib.keys import TerminalKeys, WindowKeys, first_of
    from runtime.errors import InputError, PanelLost

    if settings.output.panels:
        _check_panel(panel, len(settings.output.panels))
    try:
        panels, cards, _ = _bound(settings) if settings.output.panels else every_monitor()
    except PanelLost as error:
        raise InputError("output", "panels", str(error)) from None
    keys = TerminalKeys(quit_at_end=False)
    try:
        _check_panel(panel, len(cards))
        order = [-1] if all_at_once else [panel] if panel >= 0 else list(range(len(cards)))
        _hold(panels, cards, order, seconds, first_of(keys.poll, WindowKeys(panels).poll))
    finally:
        keys.close()
        panels.close()


def _ask(settings: Settings, config: Path) -> None:
    from calib.config_file import put_monitors, read_document, save_document
    from calib.interview import Interview
    from calib.keys import TerminalKeys, WindowKeys, first_of
    from runtime.errors import InputError, PanelLost
    from runtime.records import PanelFrame

    document = read_document(config)
    try:
        panels, cards, monitors = every_monitor()
    except PanelLost as error:
        raise InputError("output", "panels", str(error)) from None
    keys = TerminalKeys()
    try:
        try:
            interview = Interview(monitors, panels=settings.stack.stack().count, say=lambda text: typer.echo(text))
        except ValueError as problem:
            raise InputError(config, "stack.x_m", str(problem)) from None
        poll = first_of(keys.poll, WindowKeys(panels).poll)
        interview.ask()
        number = 0
        while not interview.finished:
            number += 1
            panels.present(PanelFrame(number, alone(cards, interview.shown), number))
            key = poll()
            if key is not None:
                interview.press(key)
            else:
                _pause()
    finally:
        keys.close()
        panels.close()
    if not interview.done:
        typer.echo("stopped: nothing is written", err=True)
        return
    put_monitors(document, interview.tables)
    kept = save_document(config, document)
    typer.echo(f"{config}: {len(interview.tables)} panels written" + (f"; it was {kept}" if kept else ""))


def _pause() -> None:
    import time

    time.sleep(0.05)


def _bound(settings: Settings) -> tuple[PanelSink, list[U8], tuple[Monitor, ...]]:
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
    return panels, _cards(settings, panels.monitors), panels.monitors


def every_monitor() -> tuple[PanelSink, list[U8], tuple[Monitor, ...]]:
    """Windows on all monitors whatever they are, their cards, and what they are called. Raises PanelLost."""
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
    return panels, cards, monitors


def _hold(panels: PanelSink, cards: list[U8], order: list[int], seconds: float, poll: Callable[[], Key | None]) -> None:
    """Show cards again and again, so that closed windows and lost monitors come back; keys go on to the next."""
    import time

    from calib.keys import Key
    from runtime.errors import PanelLost
    from runtime.records import PanelFrame

    deadline = time.monotonic() + seconds if seconds else float("inf")
    lost, place, number = "", 0, 0
    frame = PanelFrame(number, alone(cards, order[place]), number)
    if len(order) > 1:
        typer.echo("one panel at a time (Enter, n: the next; p: the one before; q: done)")
    try:
        while time.monotonic() < deadline:
            try:
                panels.present(frame)
                lost = ""
            except PanelLost as error:
                if str(error) != lost:
                    lost = str(error)
                    typer.echo(f"lost: {lost}", err=True)
            key = poll()
            if key is Key.QUIT:
                return
            if key in (Key.ACCEPT, Key.NEXT, Key.RIGHT, Key.PREVIOUS, Key.LEFT) and len(order) > 1:
                place = (place + (-1 if key in (Key.PREVIOUS, Key.LEFT) else 1)) % len(order)
                number += 1
                frame = PanelFrame(number, alone(cards, order[place]), number)
            elif key is None:
                _pause()
    except KeyboardInterrupt:
        return
