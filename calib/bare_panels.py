"""The panels as they are: mounted as configured, but with no registration, for what measures where they are."""

from __future__ import annotations

from calib.keys import WindowKeys
from runtime.clock import NS_PER_MS, MonotonicClock
from runtime.config import PanelSettings, Settings
from runtime.optics.stack import PanelStack
from runtime.panels.registry import open_panels, panel_settings
from runtime.records import U8, PanelFrame
from runtime.support.gl import offscreen_context

SHOW_AGAIN_NS = 50 * NS_PER_MS
IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def bare(panels: tuple[PanelSettings, ...], *, grey_curve: bool = True) -> tuple[PanelSettings, ...]:
    """Panels' settings without a homography; without `grey_curve` also without a LUT and gamma."""
    changes: dict[str, object] = {"homography": IDENTITY}
    if not grey_curve:
        changes |= {"lut": "", "gamma": 1.0}
    return tuple(panel.model_copy(update=changes) for panel in panels)


class BarePanels:
    """All panels, showing one set of layers until told another."""

    def __init__(self, settings: Settings, stack: PanelStack, *, grey_curve: bool = True) -> None:
        """Opens the panels. Raises InputError, MissingPart, PanelLost."""
        panels = bare(panel_settings(settings.output, stack.count), grey_curve=grey_curve)
        output = settings.output.model_copy(update={"panels": panels})
        self._clock = MonotonicClock()
        self._sink = open_panels(output, stack, self._clock, offscreen_context())
        self._layers: U8 | None = None
        self._number = 0
        self.keys = WindowKeys(self._sink)
        self.seen = settings.output.kind != "offscreen"

    def show(self, layers: U8) -> None:
        """(N, H, W, 4) layers on all panels. Raises PanelLost."""
        self._layers = layers
        self._number += 1
        self._sink.present(PanelFrame(self._number, layers, self._number))

    def again(self) -> None:
        """The same once more, a moment later: it takes in the windows' events and keeps them alive."""
        self._clock.sleep_until_ns(self._clock.now_ns() + SHOW_AGAIN_NS)
        if self._layers is not None:
            self.show(self._layers)

    def close(self) -> None:
        """Close the panels. May be called twice."""
        self._sink.close()
