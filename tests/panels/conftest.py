"""Contexts and X servers that tests of panels share."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import moderngl
import pytest

from runtime.clock import Clock, MonotonicClock
from runtime.config import PanelSettings
from runtime.panels.window import WindowPanels
from runtime.support.gl import offscreen_context
from tests.panels import xserver


@pytest.fixture(scope="session")
def shared_context() -> Iterator[moderngl.Context]:
    made = offscreen_context()
    yield made
    made.release()


@pytest.fixture
def gl(shared_context: moderngl.Context) -> Iterator[moderngl.Context]:
    """The shared context, made current again."""
    with shared_context:
        yield shared_context


@pytest.fixture(scope="module")
def screen(tmp_path_factory: pytest.TempPathFactory) -> Iterator[xserver.XServer]:
    server = xserver.start_or_skip(tmp_path_factory.mktemp("xorg"))
    yield server
    server.stop()


@pytest.fixture
def x(screen: xserver.XServer, monkeypatch: pytest.MonkeyPatch) -> Iterator[xserver.XServer]:
    """The X server that windows are opened on; its monitors are put right afterwards."""
    monkeypatch.setenv("DISPLAY", screen.name)
    yield screen
    screen.place(0, 1, 2)
    screen.xrandr("--query")


@pytest.fixture(params=["processor", "opengl"])
def drawn_by(request: pytest.FixtureRequest) -> str:
    """What draws in the windows."""
    return str(request.param)


@pytest.fixture
def opened(x: xserver.XServer, gl: moderngl.Context, drawn_by: str) -> Iterator[Callable[..., Any]]:
    """Opens windows that are closed at the end."""
    sinks = []

    def open_(*panels: PanelSettings, clock: Clock | None = None) -> Any:
        layer_px, on_processor = (xserver.WIDTH_PX, xserver.HEIGHT_PX), drawn_by == "processor"
        sinks.append(WindowPanels(panels, layer_px, clock or MonotonicClock(), gl, on_processor=on_processor))
        return sinks[-1]

    yield open_
    for sink in sinks:
        sink.close()
