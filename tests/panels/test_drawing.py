"""Tests what is copied to windows that the processor draws, and when, in simulated time and without an X server."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from runtime.clock import SimulatedClock
from runtime.config import PanelSettings
from runtime.optics.malus import rest_code
from runtime.optics.rect import PixelRect
from runtime.panels import drawing
from runtime.panels.drawing import ProcessorWindows
from runtime.panels.monitors import Monitor
from runtime.panels.presentation import mount_of
from runtime.panels.processor import Mounting
from runtime.panels.shared_picture import NotShared
from runtime.records import PanelFrame

SIZE = {"screen_px": (32, 16), "layer_px": (32, 16)}
MONITORS = [Monitor(f"DP-{n}", "", "", 32 * n, 0, 32, 16, 60.0) for n in range(3)]


@pytest.fixture
def puts(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What has been put on windows, (window, part); copying takes 100 ns a picture, at first 500."""
    done, clock = list[Any](), SimulatedClock()

    class Picture:
        def __init__(self, _display: int, number: int, *, width_px: int, height_px: int) -> None:
            self.number, self.pixels = number, np.zeros((height_px, width_px, 4), np.uint8)
            if number > 5:
                raise NotShared("the X server cannot reach this process's memory")

        def put(self, part: PixelRect | None = None) -> None:
            done.append((self.number, part))

        def close(self) -> None:
            done.append((self.number, "closed"))

    def finish(_display: int) -> None:
        waits = [at for at, (_, part) in enumerate(done) if part == "waited"]
        copies = len(done) - (waits[-1] + 1 if waits else 0)
        clock.advance_ns(copies * (500 if len(waits) < 2 else 100))
        done.append((-1, "waited"))

    for name, fake in (("SharedPicture", Picture), ("finish", finish), ("flush", lambda _: done.append((-1, "sent")))):
        monkeypatch.setattr(drawing, name, fake)
    monkeypatch.setattr(drawing, "x_display", lambda: 1)
    monkeypatch.setattr(drawing, "glfw", SimpleNamespace(get_x11_window=lambda handle: handle))
    done.append(clock)
    return done


def opened(clock: SimulatedClock, first: int = 0) -> ProcessorWindows:
    """Windows of three panels, numbered from `first`."""
    numbers = iter(range(first, first + 3))
    display: Any = SimpleNamespace(
        fullscreen_window=lambda _monitor, **_how: SimpleNamespace(handle=next(numbers), exposed=False)
    )
    mounts = [mount_of(PanelSettings(), **SIZE)] * 3
    return ProcessorWindows(display, MONITORS, mounts, [Mounting.of(PanelSettings(), **SIZE)] * 3, clock)


def test_only_changed_or_exposed_pictures_are_copied_and_lit_when_copied(puts: list[Any]) -> None:
    clock = puts.pop()
    windows = opened(clock)
    copied, waited = ([part for _, part in puts].count(what) for what in (None, "waited"))
    assert (copied, waited) == (12, 8) and windows.show_ns == 300 and not windows.damaged
    layers = np.full((3, 16, 32, 4), rest_code(3), np.uint8)
    whole, part = PixelRect(0, 0, 32, 16), PixelRect(6, 2, 25, 15)  # and what interpolation reaches
    for number, shown, lit_ns in (
        (1, [(0, whole), (1, whole), (2, whole)], (100, 300)),
        (2, [(1, part), (2, None)], (100, 200)),
        (2, [], (0, 0)),
    ):
        layers[1, 6:10, 10:20] = 255 if number == 2 else rest_code(3)
        windows.draw(PanelFrame(number, layers, number))
        windows.windows[2].exposed = number == 2 and bool(shown)
        assert windows.damaged == windows.windows[2].exposed
        puts.clear()
        now_ns = clock.now_ns()
        assert windows.show(clock) == (now_ns + lit_ns[0], now_ns + lit_ns[1])
        assert puts == [*shown, (-1, "sent")] and not windows.damaged
    windows.release()
    assert puts[1:] == [(n, "closed") for n in range(3)]


def test_without_shared_memory_what_was_opened_is_closed(puts: list[Any]) -> None:
    clock = puts.pop()
    with pytest.raises(NotShared):
        opened(clock, first=4)
    assert puts == [(4, "closed"), (5, "closed")]
