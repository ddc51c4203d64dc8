"""Contexts and X servers that the panels' tests share."""

from __future__ import annotations

from collections.abc import Iterator

import moderngl
import pytest

from runtime.support.gl import offscreen_context
from tests.panels import xserver


@pytest.fixture(scope="session")
def context() -> Iterator[moderngl.Context]:
    made = offscreen_context()
    yield made
    made.release()


@pytest.fixture(scope="module")
def screen(tmp_path_factory: pytest.TempPathFactory) -> Iterator[xserver.XServer]:
    server = xserver.start_or_skip(tmp_path_factory.mktemp("xorg"))
    yield server
    server.stop()
