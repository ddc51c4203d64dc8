"""Check that windows and monitors have not changed since startup, using one X query at a time.

GLFW reports when a monitor is connected or disconnected and when a window is closed or resized. It does not report when
another program destroys, unmaps or moves a window, or when a monitor's position or mode changes. After such a change, a
picture appears on the wrong panel or on none, even though every buffer swap succeeds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from runtime.clock import NS_PER_S, Clock
from runtime.panels import xlib
from runtime.panels.display import Display, Window
from runtime.panels.monitors import Monitor

EVERY_NS = NS_PER_S  # each window and monitor is queried once in this period
REFRESH_TOLERANCE = 1e-3  # relative tolerance when comparing refresh rates


class PlacementWatch:
    """Detects when a window or monitor changes. Each call to `look` checks at most one window or monitor,
    so that each of them is checked once every `EVERY_NS`. But if the X server has refused a request since the last
    call, a window or monitor has disappeared, and all of them are checked in the same call.
    """

    def __init__(self, display: Display, monitors: Sequence[Monitor], windows: Sequence[Window], clock: Clock) -> None:
        """Start watching. The first query follows after `EVERY_NS`."""
        self._display, self._clock = display, clock
        # Only the EDID is used from each of these. Positions and modes are compared with those in `monitors`.
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
        """Check a window or monitor if due; return the faults, each with its panel, or an empty string."""
        if xlib.refusals() != self._refusals:
            faults = [fault for fault in (question() for question in self._questions) if fault]
            self._refusals = xlib.refusals()  # read after the queries, because they may be refused too
            return "; ".join(faults)
        now_ns = self._clock.now_ns()
        if now_ns < self._due_ns:
            return ""
        self._due_ns = now_ns + EVERY_NS // len(self._questions)
        question = self._questions[self._next]
        self._next = (self._next + 1) % len(self._questions)
        return question()

    def _window_fault(self, panel: int) -> str:
        state, bound = self._display.window_state(self._windows[panel]), self._monitors[panel].place
        if state is None:
            return f"panel {panel}: the window was destroyed"
        is_viewable, place = state
        if not is_viewable:
            return f"panel {panel}: the window was unmapped"
        return "" if place == bound else f"panel {panel}: the window is at {place}, but must be at {bound}"

    def _monitor_fault(self, panel: int) -> str:
        monitor, then = self._monitors[panel], self._states[panel]
        now = self._display.output_state(monitor.connector)
        subject = f"panel {panel}: {monitor.connector}"
        if now is None:
            return f"{subject} was switched off or disconnected"
        if now.place != monitor.place:
            return f"{subject} changed from {monitor.place} to {now.place}"
        if monitor.refresh_hz and abs(now.refresh_hz / monitor.refresh_hz - 1.0) > REFRESH_TOLERANCE:
            return f"{subject} changed from {monitor.refresh_hz:.3f} to {now.refresh_hz:.3f} Hz"
        if then is not None and now.edid != then.edid:
            return f"a different monitor is connected to {subject}"
        return ""
