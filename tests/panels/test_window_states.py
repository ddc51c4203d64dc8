"""Tests what windows do with each frame, fault and attempt, in simulated time and without an X server."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import moderngl
import numpy as np
import pytest

from runtime.clock import NS_PER_MS, NS_PER_S, SimulatedClock
from runtime.config import PanelSettings
from runtime.errors import PanelLost
from runtime.panels import window
from runtime.panels.card import identity_card
from runtime.panels.display import glfw
from runtime.panels.drawing import WindowContextLost
from runtime.panels.monitors import Monitor, Rectangle
from runtime.panels.window import WindowPanels
from runtime.panels.xlib import OutputState
from runtime.records import PanelFrame

PANELS = tuple(PanelSettings(connector=f"DP-{n}") for n in range(2))


class Screen:
    """Stands in for the X server's display and the windows on it, and notes what is done to them."""

    def __init__(self, opengl: bool) -> None:
        self.opengl, self.clock, self.done = opengl, SimulatedClock(NS_PER_S), list[str]()
        self.connected = [Monitor(f"DP-{n}", "", "", 1920 * n, 0, 1920, 1080, 50.0) for n in range(2)]
        self.faults, self.has_windows, self.damaged, self.show_ns = list[str](), False, False, 3 * NS_PER_MS
        self.failure: Exception | None = None
        self.windows = [SimpleNamespace(handle=n, shown=True, place=self.connected[n].place) for n in range(2)]
        self.root = SimpleNamespace(make_current=lambda: None)
        self.context: Any = type("Context", (), {"__enter__": lambda _: self.done.append("context")})()

    def opened(self, *_given: Any, **_how: Any) -> Screen:
        self.done.append("open")
        self.has_windows = True
        return self

    def monitors(self) -> tuple[Monitor, ...]:
        return tuple(self.connected)

    def output_state(self, connector: str) -> OutputState:
        (monitor,) = (monitor for monitor in self.connected if monitor.connector == connector)
        return OutputState(monitor.place, monitor.refresh_hz, b"")

    def window_state(self, one: SimpleNamespace) -> tuple[bool, Any]:
        return one.shown, one.place

    def poll(self) -> str:
        return "; ".join(self.faults)

    def draw(self, frame: PanelFrame) -> None:
        self.done.append(f"draw {frame.number}")
        if self.failure is not None:
            raise self.failure

    def show(self, clock: SimulatedClock) -> tuple[int, int]:
        clock.advance_ns(2 * NS_PER_MS)
        return clock.now_ns(), clock.now_ns() + NS_PER_MS // 2

    def close_windows(self) -> None:
        self.done.append("close windows")
        self.has_windows = False
        self.faults.clear()

    def release(self) -> None:
        self.done.append("release")

    def abandon(self) -> None:
        self.done.append("abandon")

    def close(self) -> None:
        self.done.append("close display")
        self.has_windows = False


def frame(number: int) -> PanelFrame:
    return PanelFrame(number, np.zeros((2, 4, 4, 4), np.uint8), number)


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[Screen, WindowPanels]]:
    def start(*, opengl: bool = False) -> tuple[Screen, WindowPanels]:
        screen = Screen(opengl)
        monkeypatch.setattr(window, "Display", lambda: screen.done.append("display") or screen)
        monkeypatch.setattr(window, "open_windows", screen.opened)
        monkeypatch.setattr(window, "glfw", SimpleNamespace(poll_events=lambda: None, GLFWError=glfw.GLFWError))
        return screen, WindowPanels(PANELS, (1920, 1080), screen.clock, screen.context)

    return start


def did(screen: Screen) -> list[str]:
    """What has been done since the last call."""
    done, screen.done = screen.done, []
    return done


def lost(sink: WindowPanels, number: int = 9) -> str:
    with pytest.raises(PanelLost) as caught:
        sink.present(frame(number))
    return str(caught.value)


def test_a_drawn_frame_is_held_until_it_is_due_and_shown(started: Any) -> None:
    screen, sink = started()
    assert did(screen) == ["display", "open", "context"] and sink.period_ns == 20 * NS_PER_MS
    assert sink.window_handles == [0, 1] and sink.contexts_lost == 0
    report = sink.present(frame(1), due_ns=NS_PER_S + 16 * NS_PER_MS)  # 3 ms of which showing takes
    assert (report.number, report.held_ns, report.skew_ms, report.vblank_ns) == (1, 13 * NS_PER_MS, 0.5, None)
    assert report.present_ns == NS_PER_S + 15_500_000
    assert sink.present(frame(2), due_ns=NS_PER_S).held_ns == 0 and sink.present(frame(3)).held_ns is None  # late, any
    assert did(screen) == ["draw 1", "draw 2", "draw 3"]  # the context was never lent
    now_ns = screen.clock.now_ns()
    for due_ns, shown_ns in ((None, now_ns), (now_ns + 7, now_ns + 7), (now_ns - 7, now_ns)):
        report = sink.present(frame(3), unchanged=True, due_ns=due_ns)
        assert (report.number, report.present_ns, report.skew_ms, report.held_ns) == (3, shown_ns, 0.0, None)
    screen.damaged = True
    sink.present(frame(4), unchanged=True)
    sink.close()
    assert did(screen) == ["draw 4", "abandon", "close display", "context"] and sink.contexts_lost == 0


def test_frames_drawn_by_opengl_wait_for_a_blank_instead(started: Any) -> None:
    screen, sink = started(opengl=True)
    did(screen)
    report = sink.present(frame(1), unchanged=True, due_ns=2 * NS_PER_S)  # nothing has been shown yet
    assert (report.vblank_ns, report.present_ns, report.held_ns) == (NS_PER_S + 2_000_000, NS_PER_S + 2_500_000, None)
    assert sink.present(frame(1), unchanged=True, due_ns=2 * NS_PER_S).present_ns == NS_PER_S + 2_000_000
    assert did(screen) == ["draw 1", "context"]


def test_after_a_fault_windows_are_reopened_in_half_a_second(started: Any, caplog: pytest.LogCaptureFixture) -> None:
    screen, sink = started()
    sink.present(frame(1))
    did(screen)
    screen.faults.append("DP-1 was disconnected")
    assert lost(sink) == "DP-1 was disconnected" and sink.window_handles == []
    assert did(screen) == ["release", "close windows", "context"]
    screen.clock.advance_ns(NS_PER_S // 2 - 1)
    assert lost(sink) == "DP-1 was disconnected" and did(screen) == []
    screen.clock.advance_ns(1)
    with caplog.at_level("INFO"):
        assert sink.present(frame(2), unchanged=True).number == 2
    assert did(screen) == ["open", "draw 2", "context"]  # on the same display, and drawn although unchanged
    assert "panels are working again: DP-0 (1920x1080+0+0), DP-1" in caplog.text and sink.contexts_lost == 0


def test_missing_monitors_are_looked_for_every_five_seconds_or_when_x_reports(started: Any) -> None:
    screen, sink = started()
    screen.faults.append("DP-1 was disconnected")
    lost(sink)
    gone = screen.connected.pop()
    screen.clock.advance_ns(NS_PER_S // 2)
    assert "no monitor has connector DP-1" in lost(sink)
    did(screen)
    screen.connected.append(gone)
    screen.clock.advance_ns(5 * NS_PER_S - 1)
    assert "no monitor has connector DP-1" in lost(sink) and did(screen) == []
    screen.faults.append("DP-1 was connected")
    assert sink.present(frame(2)).number == 2 and screen.faults == []
    assert did(screen) == ["open", "draw 2", "context"]


@pytest.mark.parametrize("failure", [WindowContextLost("reset"), moderngl.Error("reset"), glfw.GLFWError("reset")])
def test_a_lost_context_closes_the_display_and_is_counted(started: Any, failure: Exception) -> None:
    screen, sink = started(opengl=True)
    did(screen)
    screen.failure = failure
    assert "reset" in lost(sink, 1)
    assert did(screen) == ["draw 1", "abandon", "close display", "context"] and sink.contexts_lost == 1
    screen.failure = None
    screen.clock.advance_ns(NS_PER_S // 2)
    assert sink.present(frame(2)).number == 2 and did(screen) == ["display", "open", "draw 2", "context"]
    sink.close()
    sink.close()
    assert did(screen) == ["abandon", "close display", "context", "context"] and sink.contexts_lost == 1


def test_faults_while_closing_are_logged_and_all_opens_anew(started: Any, caplog: pytest.LogCaptureFixture) -> None:
    screen, sink = started()
    screen.faults.append("DP-1 was disconnected")
    screen.close_windows = lambda: 1 / 0
    did(screen)
    assert lost(sink) == "DP-1 was disconnected" and "error while closing the windows" in caplog.text
    assert did(screen) == ["release", "abandon", "close display", "context"]
    screen.faults.clear()
    screen.clock.advance_ns(NS_PER_S // 2)
    assert sink.present(frame(2)).number == 2 and did(screen) == ["display", "open", "draw 2", "context"]
    screen.close = screen.close_windows
    sink.close()
    assert "error while closing the display" in caplog.text and did(screen) == ["abandon", "context"]


@pytest.mark.parametrize(
    ("turn", "change", "told"),
    [
        (0, {"shown": False}, "panel 0: the window was unmapped"),
        (1, {"place": Rectangle(7, 0, 5, 5)}, "panel 1: the window is at 5x5+7+0, but must be at 1920x1080+1920+0"),
        (2, {"refresh_hz": 50.06}, "panel 0: DP-0 changed from 50.000 to 50.060 Hz"),
        (3, {"y_px": 1}, "panel 1: DP-1 changed from 1920x1080+1920+0 to 1920x1080+1920+1"),
        (2, {"refresh_hz": 50.04}, ""),
    ],
)
def test_windows_and_monitors_are_asked_in_turn_within_a_second(
    started: Any, turn: int, change: dict[str, Any], told: str
) -> None:
    screen, sink = started()
    sink.present(frame(0))  # takes 2 ms
    if turn < 2:
        vars(screen.windows[turn]).update(change)
    else:
        screen.connected[turn - 2] = replace(screen.connected[turn - 2], **change)
    screen.clock.advance_ns(NS_PER_S - 2 * NS_PER_MS - 1)
    for number in range(turn + 1):  # the others, and none before its time
        assert sink.present(frame(number), unchanged=True).number == number
        screen.clock.advance_ns(1 if number == 0 else 250 * NS_PER_MS)
    assert lost(sink) == told if told else sink.present(frame(9))


def test_every_monitor_gets_a_card_with_its_setting(started: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    screen, _ = started()
    named = replace(screen.connected[0], serial="A1", model="EIZ CG27")
    screen.connected = [named, replace(screen.connected[1], width_px=1280, height_px=1440)]
    monkeypatch.setattr(window, "connected_monitors", screen.monitors)
    monkeypatch.setattr(window, "offscreen_context", lambda: screen.context)
    sink, cards, monitors = window.every_monitor()
    assert list(monitors) == screen.connected == list(sink.monitors)
    for card, title, *lines in (
        (cards[0], "DP-0", "EIZ CG27", "1920 x 1080", 'edid_serial = "A1"'),
        (cards[1], "DP-1", "(the EDID has no name)", "1280 x 1440", 'connector = "DP-1"'),
    ):
        lines[2:2] = ["in the configuration:", "[[output.panels]]"]
        assert np.array_equal(card, identity_card(1920, 1440, title=title, lines=lines))


def test_a_monitor_in_another_mode_is_refused_and_nothing_stays_open(started: Any) -> None:
    screen, _ = started()
    did(screen)
    screen.connected[1] = replace(screen.connected[1], width_px=1280)
    with pytest.raises(PanelLost, match="panel 1: DP-1 shows 1280x1080"):
        WindowPanels(PANELS, (1920, 1080), screen.clock, screen.context)
    assert did(screen) == ["display", "close display", "context"]
