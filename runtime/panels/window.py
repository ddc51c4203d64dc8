"""Show each panel's picture in a fullscreen window on its monitor, or a test card on every monitor."""

from __future__ import annotations

import logging
from typing import Any

import moderngl

from runtime.clock import NS_PER_MS, NS_PER_S, Clock, MonotonicClock
from runtime.config import PanelSettings
from runtime.errors import PanelLost
from runtime.panels.base import PanelSink
from runtime.panels.card import identity_card
from runtime.panels.display import Display, connected_monitors, glfw
from runtime.panels.drawing import PanelWindows, WindowContextLost, open_windows
from runtime.panels.monitors import Monitor, bind, check_modes, gamma_warning, refresh_difference
from runtime.panels.watch import PlacementWatch
from runtime.records import U8, PanelFrame, PresentReport
from runtime.support.gl import offscreen_context

log = logging.getLogger("phasestack.panels")

RETRY_NS = NS_PER_S // 2  # interval between attempts to reopen lost panels
LOOK_NS = 5 * NS_PER_S  # interval between searches for monitors if X sends no notification


class WindowPanels(PanelSink):
    """Output to X11 monitors, using one fullscreen window for each panel.

    `present` prepares a new solution once, draws it for all windows and then shows all windows one right after another.
    If anything fails before the first is shown, the old frame stays on all panels. With OpenGL, only the first window
    waits for its vertical blank, because with N windows waiting, the refresh rate would be divided by N. `skew_ms`, the
    time from the first panel to the last, does not include phase differences between monitors' blanks.

    Once per second, each window and monitor is compared with its initial state, by at most one query of 0.1 ms in a
    refresh. If a monitor, window or context has changed or is lost, all windows are closed and `present` raises
    PanelLost. Later calls reopen them after half a second, or as soon as X reports that monitors have changed. If the X
    server dies, the process ends with exit status 75 and must be restarted.

    GLFW requires that all methods are called on the main thread. After each, `context` is current again.
    """

    name = "windows"

    def __init__(
        self, panels: tuple[PanelSettings, ...], layer_px: tuple[int, int], clock: Clock, context: moderngl.Context, *,
        any_shape: bool = False, on_processor: bool | None = None,
    ) -> None:  # fmt: skip
        """Open a window for each panel, on monitors of any resolution (for `identify`) if `any_shape`. `on_processor`
        is that of `open_windows`. Raises InputError for the panels' settings, PanelLost for X or a monitor, which may
        be temporary, and MissingPart if GLFW does not use X11.
        """
        self._any_shape, self._on_processor = any_shape, on_processor
        self._panels, self._layer_px = panels, layer_px
        self._clock, self._context = clock, context
        self._display: Display | None = None
        self._windows: PanelWindows | None
        self._watch: PlacementWatch | None
        self._shown: bool  # True while the previous frame is on the windows
        self._away: bool  # True if a context other than `context` may be current
        self._lost = ""
        self._context_lost = False
        self.monitors: tuple[Monitor, ...] = ()
        self._forget()
        try:
            self._open()
        except BaseException:
            self._drop()
            raise
        finally:
            self._give_back()

    @property
    def period_ns(self) -> int | None:
        """Refresh period of the first panel's monitor, whose blanks pace the swaps, or None if unknown."""
        refresh_hz = self.monitors[0].refresh_hz
        return round(NS_PER_S / refresh_hz) if refresh_hz else None

    @property
    def window_handles(self) -> list[Any]:
        return [window.handle for window in self._windows.windows] if self._windows is not None else []

    def present(self, frame: PanelFrame, *, unchanged: bool = False, due_ns: int | None = None) -> PresentReport:
        """Show a frame on all panels, unless it is still on them. Raises PanelLost if anything has changed."""
        if self._windows is None and not self._may_try():
            raise PanelLost(self._lost)
        try:
            if self._windows is None:
                self._open()
                log.info("panels are working again: %s", ", ".join(str(monitor) for monitor in self.monitors))
            return self._present(frame, unchanged, due_ns)
        except (PanelLost, glfw.GLFWError, moderngl.Error) as error:
            self._lost = str(error)
            self._context_lost = isinstance(error, WindowContextLost) or not isinstance(error, PanelLost)
            self._retreat()
            raise PanelLost(self._lost) from error
        finally:
            self._give_back()

    def close(self) -> None:
        """Close all windows and their contexts. May be called more than once."""
        self._drop()
        self._give_back()

    def _present(self, frame: PanelFrame, unchanged: bool, due_ns: int | None) -> PresentReport:
        display, windows, watch = self._display, self._windows, self._watch
        assert display is not None and windows is not None and watch is not None
        if fault := display.poll() or watch.look():
            raise PanelLost(fault)
        if unchanged and self._shown and not windows.damaged:
            shown_ns = self._clock.now_ns()
            if due_ns is not None and not windows.opengl:  # a drawn frame would be held until then
                shown_ns = max(shown_ns, due_ns)
            return PresentReport(frame.number, shown_ns, 0.0)
        self._away |= windows.opengl
        windows.draw(frame)
        held_ns = None
        if due_ns is not None and not windows.opengl:
            drawn_ns = self._clock.now_ns()
            self._clock.sleep_until_ns(due_ns - windows.show_ns)
            held_ns = self._clock.now_ns() - drawn_ns
        first_ns, last_ns = windows.show(self._clock)
        self._shown = True
        blank_ns = first_ns if windows.opengl else None
        skew_ms = (last_ns - first_ns) / NS_PER_MS
        return PresentReport(frame.number, last_ns, skew_ms, vblank_ns=blank_ns, held_ns=held_ns)

    def _may_try(self) -> bool:
        """Return True if the delay before reopening is over or the connected monitors have changed."""
        display = self._display
        if display is not None and display.poll():
            display.faults.clear()
            return True
        return self._clock.now_ns() >= self._retry_ns

    def _open(self) -> None:
        self._away = True
        self._display = display = self._display or Display()
        self.monitors = bind(self._panels, display.monitors())
        if not self._any_shape:
            check_modes(self._panels, self.monitors, width_px=self._layer_px[0], height_px=self._layer_px[1])
        if difference := refresh_difference(self.monitors):
            log.warning("%s", difference)
        if changed := gamma_warning(self.monitors):
            log.warning("%s", changed)
        self._windows = windows = open_windows(
            display, self._panels, self.monitors,
            layer_px=self._layer_px, clock=self._clock, on_processor=self._on_processor,
        )  # fmt: skip
        glfw.poll_events()
        self._watch = PlacementWatch(display, self.monitors, windows.windows, self._clock)

    def _retreat(self) -> None:
        """Close the windows after a failure, but keep the shared context if it is intact."""
        if self._display is None or self._context_lost:
            self._drop()
        elif self._display.has_windows:
            self._close_windows(self._display)
        else:
            self._retry_ns = self._clock.now_ns() + LOOK_NS

    def _close_windows(self, display: Display) -> None:
        self._away = True
        try:
            if self._windows is not None:
                self._windows.release()
            display.close_windows()
        except Exception:
            log.exception("error while closing the windows")
            self._drop()
        self._forget()

    def _drop(self) -> None:
        self._away = True
        display, self._display = self._display, None
        self.contexts_lost += self._context_lost
        self._context_lost = False
        windows = self._windows
        self._forget()
        if display is not None:
            try:
                if windows is not None:
                    windows.abandon()
                display.close()
            except Exception:
                log.exception("error while closing the display")

    def _forget(self) -> None:
        """Clear all state kept for the closed windows, and schedule reopening them."""
        self._windows, self._watch, self._shown = None, None, False
        self._retry_ns = self._clock.now_ns() + RETRY_NS

    def _give_back(self) -> None:
        if self._away:
            context: Any = self._context
            context.__enter__()
            self._away = False


def every_monitor() -> tuple[WindowPanels, list[U8], tuple[Monitor, ...]]:
    """Open a window on every monitor, and return them, a test card for each, and the monitors. Raises
    PanelLost without X, monitors or windows, and MissingPart without GLFW on X11 or OpenGL 3.3 by EGL.
    """
    monitors = connected_monitors()
    width, height = max(m.width_px for m in monitors), max(m.height_px for m in monitors)
    bound = tuple(PanelSettings(connector=monitor.connector) for monitor in monitors)
    panels = WindowPanels(bound, (width, height), MonotonicClock(), offscreen_context(), any_shape=True)
    cards = []
    for monitor in monitors:
        lines = [monitor.model or "(the EDID has no name)", f"{monitor.width_px} x {monitor.height_px}",
                 "in the configuration:", "[[output.panels]]", monitor.setting(monitors)]  # fmt: skip
        cards.append(identity_card(width, height, title=monitor.connector, lines=lines))
    return panels, cards, monitors
