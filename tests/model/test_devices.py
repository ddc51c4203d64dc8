"""What every device keeps, sets and writes, value by value."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from runtime.model.buffers import LayerBuffer
from runtime.model.contract import Step
from runtime.model.cpu import CpuBackend
from runtime.model.gl.state import GlBackend
from runtime.model.job import Job, SolveWindow, Targets, drawn_job, drawn_views
from runtime.optics.rect import PixelRect
from runtime.optics.stack import PanelStack
from runtime.support.gl import offscreen_context
from tests.model.scenes import eyes

STACK = PanelStack(0.064, 0.048, (-0.002, 0.0, 0.002), 64, 48)
WINDOW = SolveWindow(PixelRect(8, 8, 56, 40), PixelRect(16, 10, 48, 36), (0.0, 0.0))
REST = 2040


@pytest.fixture(scope="module", params=["cpu", "gl"])
def backend(request: Any) -> Iterator[Any]:
    if request.param == "cpu":
        yield CpuBackend()
        return
    context = offscreen_context()
    context.__enter__()
    device = GlBackend(context, STACK)
    yield device
    context.__enter__()
    for _ in range(2):
        device.close()
    context.release()


def job(channels: int = 3) -> Job:
    pictures = [np.full((48, 64, 4), (code, code // 2, 0, 255), np.uint8) for code in (200, 240)]
    return replace(drawn_job(pictures, eyes(0.6), STACK), channels=channels, eye_sigma_m=0.0)


def codes(channels: int, seed: int = 0) -> Any:
    """Values for a box, on whole codes."""
    shape = (32, 48, 3) if channels == 3 else (32, 48)
    return np.random.default_rng(seed).integers(0, 256, shape).astype(np.int16) * 16


@pytest.mark.parametrize("channels", [1, 3])
def test_panels_keep_what_is_set_and_rest_otherwise(backend: Any, channels: int) -> None:
    state = backend.state(STACK, threads=2)
    geometry = job().targets.within(WINDOW)
    with state.begin(job(channels), geometry) as solving:
        solving.set_panel(0, codes(channels))
        solving.start()
        first, middle, front = (solving.panel(n).astype(int) for n in range(3))
        assert first.shape == (32, 48, channels)
        assert np.abs(first.reshape(codes(channels).shape) - codes(channels)).max() <= 1
        assert np.abs(middle - REST).max() <= 1 and np.abs(front - REST).max() <= 1
        solving.step(Step(size=1.0))
        stepped = [solving.panel(n).astype(int) for n in range(3)]
        assert np.abs(stepped[0] - first).max() > 50
    with state.begin(job(channels), geometry, resumed=True) as solving:
        assert all((solving.panel(n) == panel).all() for n, panel in enumerate(stepped))
    with state.begin(job(channels), geometry) as solving:
        solving.close_middle()  # whatever the middle panel held
        assert np.abs(solving.panel(0).astype(int) - REST).max() <= 1
        assert np.abs(solving.panel(1).astype(int) - REST).max() > 100
    state.close()
    state.close()


def test_a_panel_without_filters_gets_its_channels_mean(backend: Any) -> None:
    stack = replace(STACK, colour=(True, True, False))
    state, geometry = backend.state(stack, threads=1), replace(job().targets.within(WINDOW), stack=stack)
    asked = replace(job(), targets=replace(job().targets, stack=stack))
    with state.begin(asked, geometry) as solving:
        for n in (0, 2):
            solving.set_panel(n, codes(3))
        solving.start()
        means = codes(3).mean(axis=2, keepdims=True).repeat(3, 2)
        assert np.abs(solving.panel(0) - codes(3)).max() <= 1 and np.abs(solving.panel(2) - means).max() <= 1
    state.close()


def test_layers_show_panels_inside_and_rest_outside_a_window(backend: Any) -> None:
    state, geometry = backend.state(STACK, threads=2), job().targets.within(WINDOW)
    buffer = LayerBuffer(np.full((3, 48, 64, 4), 9, np.uint8))
    colour = (255, 0, 128)
    cases = [
        (3, 77, [77] * 3),
        (1, 78, [78] * 3),
        (3, colour, [0, 255, 127]),
        (3, None, [0, 255, 127]),
        (3, 77, [77] * 3),
    ]
    for seed, (channels, outside, shown) in enumerate(cases):
        wanted = np.full((3, 48, 64, 4), (128, 128, 128, 255), np.uint8)
        wanted[1, ..., :3] = shown
        with state.begin(job(channels), geometry) as solving:
            for n, rect in enumerate((WINDOW.box, WINDOW.kept, WINDOW.box)):
                values = codes(channels, seed + n)
                solving.set_panel(n, values)
                whole = np.zeros((48, 64, 3), np.uint8)
                whole[WINDOW.box.slices] = values.reshape(32, 48, -1) // 16
                wanted[n][rect.slices][..., :3] = whole[rect.slices]
            solving.start()
            solving.write(buffer, outside)
        assert (buffer.pixels == wanted).all(), seed
    nothing = replace(geometry, kept=PixelRect(16, 10, 16, 10))
    with state.begin(job(), nothing) as solving:
        solving.start()
        solving.write(buffer, 77)
    assert (buffer.pixels[1, ..., :3] == 77).all()
    state.close()


def smooth(seed: int, size: tuple[int, int]) -> Any:
    noise = cv2.GaussianBlur(np.random.default_rng(seed).random((*size, 3)), (0, 0), 3.0)
    return np.rint(255 * np.clip(0.5 + 4 * (noise - 0.5), 0.1, 0.9))


@pytest.mark.parametrize(
    ("views", "channels", "panels", "filters"),
    [(2, 3, 3, True), (8, 3, 3, True), (2, 3, 3, False), (2, 1, 3, True), (2, 3, 2, True), (3, 3, 4, True)],
)
def test_steps_move_every_device_s_panels_alike(
    backend: Any, views: int, channels: int, panels: int, filters: bool
) -> None:
    """To the rounding of 16-bit numbers; a step moves the panels a hundred times as far."""
    x_m = tuple(np.linspace(-0.01, 0.01, panels).tolist())
    stack = replace(STACK, x_m=x_m, colour=(True,) * (panels - 1) + (filters,))
    at = np.concatenate([eyes(0.6, side_m) for side_m in (0.0, 0.02, -0.02, 0.04)])[:views]
    pictures = [smooth(9 + view, (48, 64)).astype(np.uint8) for view in range(views)]
    asked = Job(Targets(stack, at, drawn_views(pictures, stack)), eye_sigma_m=0.01, channels=channels)
    geometry, found = asked.targets.within(replace(WINDOW, taper_px=(30.0, 20.0))), []
    for device in (CpuBackend(), backend):
        with device.state(stack, threads=1).begin(asked, geometry) as solving:
            steps = []
            for n in range(panels):
                values = 16 * smooth(n, (32, 48)).astype(np.int16)
                solving.set_panel(n, values if channels == 3 else np.ascontiguousarray(values[..., 0]))
            solving.start()
            for size, places in ((0.7, "rising"), (0.5, "middle"), (0.5, "falling"), (0.0, "middle")):
                if size:
                    solving.step(Step(size=size, places=places))  # type: ignore[arg-type]
                else:
                    solving.close_middle()
                steps.append([solving.panel(n).astype(int) for n in range(panels)])
        found.append(np.array(steps))
    assert np.abs(found[0][1] - found[0][0]).mean() > 30
    assert np.abs(found[1] - found[0]).mean(axis=(2, 3, 4)).max() < 3
