"""Fixtures for tests of content: one GL context, the display of the paper, and views of it."""

from __future__ import annotations

import gc
import pickle
from collections.abc import Callable, Iterator
from typing import Any

import moderngl
import numpy as np
import pytest
from numpy.typing import ArrayLike

from runtime.config import ContentSettings
from runtime.content import registry
from runtime.content.base import View
from runtime.content.registry import open_content
from runtime.optics.stack import PanelStack, PlaneRaster
from runtime.optics.views import image_from_stack, raster_from_stack
from runtime.support.gl import offscreen_context

STACK = PanelStack(
    0.5184, 0.2916, (-0.06, 0.0, 0.06), 480, 270
)  # the paper's display at a quarter of its pixels each way


@pytest.fixture(scope="session")
def shared_context() -> Any:
    return offscreen_context()


@pytest.fixture
def context(shared_context: Any) -> Iterator[Any]:
    """The shared context, made current again, or one of the test's own if an earlier test has left it unusable."""
    gc.disable()  # a collected object of an earlier test must not take the context away
    try:
        with shared_context:
            if is_usable(shared_context):
                yield shared_context
                return
        own = offscreen_context()
        yield own
        own.release()
    finally:
        gc.enable()


def is_usable(context: Any) -> bool:
    try:
        context.buffer(reserve=4).release()
    except moderngl.Error:
        return False
    return True


@pytest.fixture
def opened(context: Any) -> Iterator[Callable[..., Any]]:
    """Opens a scene, a file or a folder with further settings of content, until the test ends."""
    sources = []

    def open_scene(scene: object, **settings: Any) -> Any:
        sources.append(open_content(ContentSettings(scene=str(scene), **settings), STACK, context))
        return sources[-1]

    yield open_scene
    for source in sources:
        source.close()


@pytest.fixture
def drawn(opened: Any) -> Callable[..., np.ndarray]:
    """Opens a scene as `opened`, and draws it for an eye in the pixels of the middle panel."""

    def draw(
        scene: object, eye_m: ArrayLike = (0.6, 0, 0), side: int = 0, time_ns: int = 0, **settings: Any
    ) -> np.ndarray:
        view = panel_view(eye_m, STACK.panel(1), side)
        return np.array(opened(scene, **settings).render(view, time_ns=time_ns))

    return draw


@pytest.fixture(autouse=True)
def files_are_read_here(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Read files in this process, except in tests marked `child`: a process takes a second to start."""

    def here(work: Callable[..., Any], *given: Any, source: object, seconds: float) -> Any:
        return pickle.loads(pickle.dumps(work(*given), protocol=5))

    if request.node.get_closest_marker("child") is None:
        monkeypatch.setattr(registry, "in_child", here)


def panel_view(eye_m: ArrayLike, raster: PlaneRaster, side: int = 0) -> View:
    """An eye's view, in a plane's pixels."""
    eye = np.asarray(eye_m, dtype=np.float64)
    return View(eye, side, raster_from_stack(eye, raster), raster.width_px, raster.height_px)


def image_view(eye_m: ArrayLike, width_px: int, height_px: int, fov_deg: float = 40.0, side: int = 0) -> View:
    """An eye's view, in its own image."""
    eye = np.asarray(eye_m, dtype=np.float64)
    projection = image_from_stack(eye, width_px=width_px, height_px=height_px, fov_deg=fov_deg)
    return View(eye, side, projection, width_px, height_px)
