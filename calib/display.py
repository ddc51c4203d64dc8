"""Show layers on the panels during setup, and read keys pressed in their windows."""

from __future__ import annotations

import numpy as np
import typer

from calib.keys import Key, TerminalKeys, WindowKeys
from runtime.clock import NS_PER_MS, MonotonicClock
from runtime.config import Settings
from runtime.panels.base import PanelSink
from runtime.panels.registry import open_panels, panel_settings
from runtime.records import U8, PanelFrame
from runtime.support.gl import offscreen_context

POLL_NS = 50 * NS_PER_MS  # interval between polls for keys
IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class PanelDisplay:
    """Open panels that keep showing a set of layers and report keys pressed in their windows."""

    def __init__(self, sink: PanelSink) -> None:
        self._sink = sink
        self._layers: U8 | None = None
        self._number = 0
        self._keys = WindowKeys(sink)

    def show(self, layers: U8) -> None:
        """Show layers (N, H, W, 4) on the panels. Raises PanelLost if a panel is lost."""
        self._layers = layers
        self._number += 1
        self._sink.present(PanelFrame(self._number, layers, self._number))

    def key(self) -> Key | None:
        """Return the next key pressed, or None, and present again to stay responsive. Raises PanelLost."""
        if self._layers is not None:
            self.show(self._layers)
        return self._keys.poll()

    def close(self) -> None:
        """Close the panels' windows. Further calls have no effect."""
        self._sink.close()


def open_display(settings: Settings, *, registered: bool = False, grey_curve: bool = True) -> PanelDisplay:
    """Open the configured panels, with each one's homography if `registered`, and its gamma or LUT if
    `grey_curve`. Raises InputError for the settings, MissingPart without OpenGL or X11, and PanelLost without a
    monitor.
    """
    stack = settings.stack.stack()
    changes: dict[str, object] = {} if registered else {"homography": IDENTITY}
    if not grey_curve:
        changes |= {"lut": "", "gamma": 1.0}
    panels = tuple(panel.model_copy(update=changes) for panel in panel_settings(settings.output, stack.count))
    output = settings.output.model_copy(update={"panels": panels})
    if output.kind == "offscreen":
        typer.echo("warning: the charts are not visible because output.kind is offscreen", err=True)
    return PanelDisplay(open_panels(output, stack, MonotonicClock(), offscreen_context()))


def show_until_key(display: PanelDisplay, layers: U8, title: str) -> None:
    """Show layers (N, H, W, 4) until Enter or q is pressed, and close the display. Raises PanelLost."""
    keys, clock = TerminalKeys(), MonotonicClock()
    try:
        display.show(layers)
        typer.echo(f"{title} (press Enter or q when done)", err=True)
        while (keys.poll() or display.key()) not in (Key.ACCEPT, Key.QUIT):
            clock.sleep_until_ns(clock.now_ns() + POLL_NS)
    finally:
        display.close()
        keys.close()


def grey_layers(pictures: U8) -> U8:
    """Convert one grey picture per panel (N, H, W) to layers (N, H, W, 4) with opaque alpha."""
    return np.concatenate([np.repeat(pictures[..., None], 3, axis=-1), np.full_like(pictures[..., None], 255)], axis=-1)
