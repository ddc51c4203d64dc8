"""`phasestack identify`: show each panel's name and orientation on the panel itself."""

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
    config: Annotated[Path | None, typer.Option(help="configuration with the panels (default: every monitor)")] = None,
) -> None:
    """Show a test card on each panel: its index, monitor, colour bars and an arrow that should point up.

    Only one panel at a time shows its card; the others are clear. Press Enter or n for the next panel, p for the
    previous one, and q to quit. Configured panels are rotated, mirrored and registered as in a run. If no panels are
    configured, each monitor shows the line that selects it in a configuration. (`phasestack setup` writes this line for
    you.)

    Exits with 75 if the X server dies.

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
                typer.echo(f"{monitor}: [[output.panels]] {monitor.setting(monitors)}")
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
    """Open the configured panels with a test card for each. Raises InputError, or PanelLost without a monitor or X."""
    from runtime.clock import MonotonicClock
    from runtime.panels.card import identity_card
    from runtime.panels.window import WindowPanels
    from runtime.support.gl import offscreen_context

    stack = settings.stack.stack()
    mounted = settings.output.panels
    panels = WindowPanels(mounted, (stack.width_px, stack.height_px), MonotonicClock(), offscreen_context())
    cards = []
    for index, (panel, monitor) in enumerate(zip(mounted, panels.monitors, strict=True)):
        typer.echo(f"panel {index}: {monitor}")
        lines = [
            f"at x = {stack.x_m[index] * 100:+.1f} cm",
            *str(monitor).replace(" (", "\n(").splitlines(),
            f"rotation {panel.rotation_deg} degrees, mirroring {panel.mirror}",
        ]
        cards.append(identity_card(stack.width_px, stack.height_px, title=f"PANEL {index}", lines=lines))
    return panels, cards


def _hold(panels: PanelSink, cards: list[U8], poll: Callable[[], Key | None]) -> None:
    """Show one card at a time until q is pressed. Reopens closed windows and those on lost monitors."""
    import time

    from calib.keys import Key
    from runtime.errors import PanelLost
    from runtime.panels.card import alone
    from runtime.records import PanelFrame

    lost, number = "", 0  # frame number, incremented at each key press
    shown, layers = 0, alone(cards, 0)
    typer.echo("press Enter or n for the next panel, p for the previous panel, or q to quit")
    try:
        while True:
            try:
                panels.present(PanelFrame(number, layers, number))
                lost = ""
            except PanelLost as error:
                if str(error) != lost:
                    lost = str(error)
                    typer.echo(f"a panel was lost: {lost}", err=True)
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
