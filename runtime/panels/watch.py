"""Watches whether windows and monitors are still as bound, by one question to X at a time.

GLFW reports monitors that come and go and of windows that are asked to close or become another size. It doesn't
report a window that somebody destroyed, unmapped or moved, nor a monitor that got another place or mode: what is shown
then is on the wrong panel, or on none, and every swap succeeds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from runtime.clock import NS_PER_S, Clock
from runtime.panels import xlib
from runtime.panels.display import Display, Window
from runtime.panels.monitors import Monitor

EVERY_NS = NS_PER_S  # a round of all questions
REFRESH_TOLERANCE = 1e-3  # of a monitor's rate


class PlacementWatch:
    """Every window and every monitor is looked at once in EVERY_NS, one of them a call.

    All at once where the X server has refused a request since the last look: something has gone.
    """

    def __init__(self, display: Display, monitors: Sequence[Monitor], windows: Sequence[Window], clock: Clock) -> None:
        """monitors: as bound, with their windows, one per panel. Nothing is asked in the first EVERY_NS."""
        self._display, self._clock = display, clock
        # Against what was there when it was bound; what came between binding and here differs from the monitor.
        self._states = [display.output_state(monitor.connector) for monitor in monitors]
        self._monitors, self._windows = monitors, windows
        self._questions: list[Callable[[], str]] = [
            *(partial(self._window_fault, panel) for panel in range(len(windows))),
            *(partial(self._monitor_fault, panel) for panel in range(len(monitors))),
        ]
        self._next = 0
        self._due_ns = clock.now_ns() + EVERY_NS
        self._refusals = xlib.refusals()

    def look(self) -> str:
        """What is wrong, with which panel; empty: nothing, or no question was due."""
        if xlib.refusals() != self._refusals:
            faults = [fault for fault in (question() for question in self._questions) if fault]
            self._refusals = xlib.refusals()  # after the questions: those about what has gone are refused too
            return "; ".join(faults)
        now_ns = self._clock.now_ns()
        if now_ns < self._due_ns:
            return ""
        self._due_ns = now_ns + EVERY_NS // len(self._questions)
        question = self._questions[self._next]
        self._next = (self._next + 1) % len(self._questions)
        return question()

    def _window_fault(self, panel: int) -> str:
        state, wanted = self._display.window_state(self._windows[panel]), self._monitors[panel].place
        if state is None:
            return f"panel {panel}: the window was destroyed"
        is_viewable, place = state
        if not is_viewable:
            return f"panel {panel}: the window was unmapped"
        return "" if place == wanted else f"panel {panel}: the window is {place}, not {wanted}"

    def _monitor_fault(self, panel: int) -> str:
        monitor, then = self._monitors[panel], self._states[panel]
        now = self._display.output_state(monitor.connector)
        whose = f"panel {panel}: {monitor.connector}"
        if now is None:
            return f"{whose} shows nothing any more"
        if now.place != monitor.place:
            return f"{whose} became {now.place}, it was {monitor.place}"
        if monitor.refresh_hz and abs(now.refresh_hz / monitor.refresh_hz - 1.0) > REFRESH_TOLERANCE:
            return f"{whose} shows {now.refresh_hz:.3f} frames a second, it was {monitor.refresh_hz:.3f}"
        if then is not None and now.edid != then.edid:
            return f"{whose} has another monitor"
        return ""
