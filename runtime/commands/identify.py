"""`phasestack identify`: shows each panel its own name and which way is up."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from collections.abc import Callable

    from calib.keys import Key
    from runtime.config import Settings
    from runtime.panels.base import PanelSink
    from runtime.records import U8


def identify(
    config: Annotated[Path | None, typer.Option(help="configuration; without one, every monitor is shown")] = None,
) -> None:
    """Show a panel its index, its monitor, an arrow that should point up, colour bars and its edges.

    Panels stand behind one another: one shows its card, the others are clear; Enter or n goes to the next, p back, q
    ends. With panels in the configuration they are bound, turned, mirrored and registered as they will be when it
    runs. Without any, every monitor tells how to name it in the configuration; `phasestack setup` asks for that.

    Exits with 75 where the X server dies.

    Example: phasestack identify --config phasestack.toml
    """
    from calib.keys import TerminalKeys, WindowKeys
    from runtime.config import load_settings
    from runtime.errors import InputError, PanelLost
    from runtime.panels.window import every_monitor

    settings = load_settings(config)
    try:
        if settings.output.panels:
            panels, cards = _bound(settings)
        else:
            panels, cards, monitors = every_monitor()
            for monitor in monitors:
                typer.echo(f"{monitor}: [[output.panels]] {monitor.setting}")
    except PanelLost as error:
        raise InputError("output", "panels", str(error)) from None
    keys = TerminalKeys(quit_at_end=False)
    try:
        windows = WindowKeys(panels)
        _hold(panels, cards, lambda: keys.poll() or windows.poll())
    finally:
        keys.close()
        panels.close()


def _bound(settings: Settings) -> tuple[PanelSink, list[U8]]:
    """The configured panels and their cards. Raises InputError, PanelLost."""
    from runtime.clock import MonotonicClock
    from runtime.panels.card import identity_card
    from runtime.panels.window import WindowPanels
    from runtime.support.gl import offscreen_context

    stack = settings.stack.stack()
    mounted = settings.output.panels
    panels = WindowPanels(mounted, stack, MonotonicClock(), offscreen_context())
    cards = []
    for index, (panel, monitor) in enumerate(zip(mounted, panels.monitors, strict=True)):
        typer.echo(f"panel {index}: {monitor}")
        lines = [
            f"at x = {stack.x_m[index] * 100:+.1f} cm",
            *str(monitor).replace(" (", "\n(").splitlines(),
            f"mounted at {panel.rotation_deg} degrees, mirroring {panel.mirror}",
        ]
        cards.append(identity_card(stack.width_px, stack.height_px, title=f"PANEL {index}", lines=lines))
    return panels, cards


def _hold(panels: PanelSink, cards: list[U8], poll: Callable[[], Key | None]) -> None:
    """Show cards again and again, so that closed windows and lost monitors come back; keys go on to the next."""
    import time

    from calib.keys import Key
    from runtime.errors import PanelLost
    from runtime.panels.card import alone
    from runtime.records import PanelFrame

    lost, number = "", 0  # of presses, so that each is another frame
    shown, layers = 0, alone(cards, 0)
    typer.echo("one panel at a time (Enter, n: the next; p: the one before; q: done)")
    try:
        while True:
            try:
                panels.present(PanelFrame(number, layers, number))
                lost = ""
            except PanelLost as error:
                if str(error) != lost:
                    lost = str(error)
                    typer.echo(f"lost: {lost}", err=True)
            key = poll()
            if key is Key.QUIT:
                return
            if key in (Key.ACCEPT, Key.NEXT, Key.RIGHT, Key.PREVIOUS, Key.LEFT):
                shown = (shown + (-1 if key in (Key.PREVIOUS, Key.LEFT) else 1)) % len(cards)
                number, layers = number + 1, alone(cards, shown)
            elif key is None:
                time.sleep(0.05)
    except KeyboardInterrupt:
        return
