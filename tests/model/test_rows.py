"""Strips of rows on a few threads, and the buffers that the solver's steps work on."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from runtime.model.chain import chain_frame
from runtime.model.pyramid_level import PyramidLevel
from runtime.model.rows import STRIP, RowPool
from runtime.model.workspace import Workspace
from runtime.optics.rect import PixelRect
from runtime.optics.stack import PanelStack
from tests.model.scenes import eyes

SHAPES = [(5, 7), (1080, 1920, 3), (3, 40_000, 3), (700, 900)]


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("shape", SHAPES)
def test_every_row_is_worked_on_once(threads: int, shape: tuple[int, ...]) -> None:
    pool = RowPool(threads, width_px=40_000)
    times = np.zeros(shape[0], int)

    def work(rows: slice, strip: np.ndarray) -> None:
        assert strip.shape == (rows.stop - rows.start, *shape[1:]) and strip.dtype == np.int16
        times[rows] += 1

    pool.each(shape, work)
    pool.close()
    assert (times == 1).all()


def test_large_images_are_shared_by_threads_and_small_ones_are_not() -> None:
    pool = RowPool(2, width_px=1920)
    for shape, most in (((1080, 1920, 3), 2), ((10, 10, 3), 1)):
        threads, strips = set(), []

        def work(rows: slice, strip: np.ndarray, threads: set = threads, strips: list = strips) -> None:
            threads.add(threading.current_thread().name)
            strips.append(strip.size)

        pool.each(shape, work)
        assert len(threads) <= most and (most == 2) == all(name.startswith("rows") for name in threads)
        assert max(strips) <= STRIP
    pool.close()
    pool.close()


def test_what_the_work_raises_is_raised() -> None:
    def broken(rows: slice, strip: np.ndarray) -> None:
        raise ZeroDivisionError

    for threads, shape in ((1, (4, 4)), (2, (1080, 1920, 3))):
        pool = RowPool(threads, width_px=1920)
        with pytest.raises(ZeroDivisionError):
            pool.each(shape, broken)
        pool.close()


def test_a_workspace_keeps_its_buffers_while_the_eyes_see_the_same_and_the_network_the_same_raster() -> None:
    stack = PanelStack(0.48, 0.24, (-0.06, 0.0, 0.06), 96, 48)
    pool = RowPool(1, width_px=96)
    workspace = Workspace(stack, {1, 2}, level=PyramidLevel, rows=pool, channels=3)
    boxes = (PixelRect(0, 0, 96, 48), PixelRect(8, 8, 88, 40), PixelRect(16, 8, 96, 40))
    workspace.crop(boxes, stack)
    whole = workspace.levels[1]
    wanted, outer = whole.target, whole.outer
    assert [image.shape for image in (outer[0], wanted[0], outer[2])] == [(48, 96, 3), (32, 80, 3), (32, 80, 3)]
    assert workspace.levels[2].size == (40, 16)
    workspace.crop(boxes, stack)
    assert whole.target is wanted and whole.outer is outer
    workspace.crop((boxes[0],) * 3, stack)
    assert workspace.levels[2].size == (48, 24)
    near, far = (chain_frame(eyes(distance_m), stack, cell_px=4, reduction=2) for distance_m in (0.4, 1.5))
    first = workspace.chain_buffers(near)
    assert first[0].shape == (near.rows, near.width_px, 3)
    assert workspace.chain_buffers(near) is first
    assert workspace.chain_buffers(far)[0].shape == (far.rows, far.width_px, 3)
    pool.close()
