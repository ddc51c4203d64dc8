"""Tests that changes to windows and monitors that GLFW does not report are found."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import pytest

from runtime.clock import NS_PER_S, SimulatedClock
from runtime.errors import PanelLost
from runtime.panels.display import glfw
from runtime.panels.watch import PlacementWatch
from runtime.panels.window import WindowPanels
from tests.panels.edids import block
from tests.panels.test_windows import BY_CONNECTOR, frame, picture, presents, shows
from tests.panels.xserver import XServer
from tests.waiting import eventually

pytestmark = pytest.mark.windows
EVERY_S = 0.1  # a round of all questions


@pytest.fixture(autouse=True)
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorten the intervals, which are seconds in the runtime."""
    for name in ("watch.EVERY_NS", "window.RETRY_NS", "window.LOOK_NS"):
        monkeypatch.setattr(f"runtime.panels.{name}", round(EVERY_S * NS_PER_S))


def lost(sink: WindowPanels, *, unchanged: bool = False, within_s: float = 3.0) -> str:
    """Reported loss of a panel during refreshes at 60 Hz; empty: none within `within_s`."""
    deadline = time.monotonic() + within_s
    number = 1000
    while time.monotonic() < deadline:
        try:
            sink.present(frame(number), unchanged=unchanged)
        except PanelLost as error:
            return str(error)
        time.sleep(1 / 60)
    return ""


def x11_window(sink: WindowPanels, panel: int) -> int:
    return glfw.get_x11_window(sink.window_handles[panel])


def comes_back(x: XServer, sink: WindowPanels, *monitors: int) -> bool:
    return eventually(lambda: presents(sink, 7)) and all(
        shows(x, monitor, picture(7, index)) for index, monitor in enumerate(monitors)
    )


@pytest.mark.parametrize("unchanged", [False, True])
@pytest.mark.parametrize(
    ("does", "told"),
    [
        (lambda x, window: x.ask_to_close(window), "a panel's window was closed"),
        (lambda x, window: x.do_to_window("XDestroyWindow", window), "panel 1: the window was destroyed"),
        (lambda x, window: x.do_to_window("XUnmapWindow", window), "panel 1: the window was unmapped"),
        (
            lambda x, window: x.do_to_window("XMoveWindow", window, 600, 7),
            "panel 1: the window is at 320x180+600+7, but must be at 320x180+0+0",
        ),
    ],
)
def test_windows_closed_taken_or_moved_are_lost_panels_and_come_back(
    x: XServer, opened: Callable[..., Any], does: Callable[..., None], told: str, unchanged: bool
) -> None:
    sink = opened(*BY_CONNECTOR)
    assert presents(sink, 0)
    does(x, x11_window(sink, 1))
    assert told in lost(sink, unchanged=unchanged)
    assert comes_back(x, sink, 2, 0, 1)


def test_layers_follow_monitors_that_change_places(x: XServer, opened: Callable[..., Any]) -> None:
    sink = opened(*BY_CONNECTOR)
    assert presents(sink, 0)
    x.place(1, 0, 2)
    assert "changed from 320x180+0+0 to 320x180+320+0" in lost(sink)
    assert comes_back(x, sink, 2, 1, 0)  # panel 1 is on DUMMY0, which is in the middle now
    assert [monitor.connector for monitor in sink.monitors] == ["DUMMY2", "DUMMY0", "DUMMY1"]


def test_a_monitor_in_a_wrong_mode_is_held_and_named(x: XServer, opened: Callable[..., Any]) -> None:
    sink = opened(*BY_CONNECTOR)
    assert presents(sink, 0)
    x.set_mode(0, "tall")
    assert "160x180" in lost(sink)
    assert eventually(lambda: "panel 1: DUMMY0 shows 160x180" in lost(sink, within_s=0.1))
    x.plug(0)
    assert comes_back(x, sink, 2, 0, 1)


def test_another_rate_is_another_pace(x: XServer, opened: Callable[..., Any]) -> None:
    sink = opened(*BY_CONNECTOR)
    assert presents(sink, 0)
    x.set_mode(2, "slow")
    assert "changed from 60.000 to 50.000 Hz" in lost(sink)
    assert eventually(lambda: presents(sink, 7))
    assert sink.period_ns == pytest.approx(NS_PER_S / 50, rel=1e-3)


def test_another_monitor_at_the_same_connector_is_noticed(x: XServer, opened: Callable[..., Any]) -> None:
    x.set_edid(0, block(serial_text="ONE"))
    sink = opened(*BY_CONNECTOR)
    assert presents(sink, 0)
    x.set_edid(0, block(serial_text="OTHER"))
    assert "a different monitor is connected to panel 1: DUMMY0" in lost(sink)
    assert eventually(lambda: presents(sink, 7))
    assert sink.monitors[1].serial == "OTHER"


def test_where_nothing_happens_nothing_is_lost(opened: Callable[..., Any]) -> None:
    sink = opened(*BY_CONNECTOR)
    assert lost(sink, within_s=6 * EVERY_S) == ""


def test_a_refused_request_makes_it_look_at_everything_at_once(x: XServer, opened: Callable[..., Any]) -> None:
    sink = opened(*BY_CONNECTOR)
    windows = sink._windows.windows
    watch = PlacementWatch(sink._display, sink.monitors, windows, SimulatedClock())  # whose time never comes
    x.do_to_window("XDestroyWindow", x11_window(sink, 0))
    x.xrandr("--query")
    assert watch.look() == ""
    assert sink._display.window_state(windows[0]) is None  # refused
    assert watch.look() == "panel 0: the window was destroyed"
