"""Contexts that share textures: drawn on one thread, shown and read on others, reused when nobody holds them."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from runtime.errors import ContextLost
from runtime.records import U8
from runtime.support.gl import offscreen_context
from runtime.support.gl_sharing import LayerPool, ShareGroup
from tests.support.left_in_textures import in_a_thread, on_a_thread_of_its_own, written

NOISE: U8 = np.random.default_rng(3).integers(0, 256, (3, 18, 32, 4), dtype=np.uint8)


@pytest.fixture
def first() -> Iterator[Any]:
    context = offscreen_context()
    with context:
        yield context
    context.release()


@pytest.fixture
def group(first: Any) -> Iterator[ShareGroup]:
    made = ShareGroup()
    yield made
    made.close()


def test_what_one_thread_left_another_reads_without_a_context(group: ShareGroup) -> None:
    left = on_a_thread_of_its_own(group, NOISE)
    assert left.shape == NOISE.shape
    assert np.array_equal(in_a_thread(left.pixels), NOISE)
    assert left.pixels() is left.pixels()


def test_reading_leaves_the_thread_its_own_context(first: Any, group: ShareGroup) -> None:
    left = on_a_thread_of_its_own(group, NOISE)
    target = first.simple_framebuffer((4, 4))
    target.use()
    left.pixels()
    target.clear(1.0)
    assert target.read(components=1) == b"\xff" * 16
    assert first.error == "GL_NO_ERROR"


def test_the_first_context_samples_what_another_drew(first: Any, group: ShareGroup) -> None:
    left = on_a_thread_of_its_own(group, NOISE)
    target = first.framebuffer([first.external_texture(left.textures[1].glo, (32, 18), 4, 0, "f1")])
    assert np.array_equal(np.frombuffer(target.read(components=4), np.uint8), NOISE[1].ravel())


def test_textures_are_drawn_over_only_when_nobody_holds_them(first: Any, group: ShareGroup) -> None:
    pool = LayerPool(first, group)
    one, two = written(pool, NOISE), written(pool, 255 - NOISE)
    assert pool.count == 6
    assert not set(one.textures) & set(two.textures)
    kept = one.textures
    del one
    gc.collect()
    three = written(pool, NOISE // 2)
    assert three.textures is kept
    assert pool.count == 6
    assert np.array_equal(two.pixels(), 255 - NOISE)
    assert np.array_equal(three.pixels(), NOISE // 2)


def test_textures_of_sizes_that_nobody_asks_for_any_more_are_surplus(first: Any, group: ShareGroup) -> None:
    pool = LayerPool(first, group)
    for width in range(10, 30):
        pool.taken(3, width_px=width, height_px=8)
        for textures in pool.surplus():
            for texture in textures:
                texture.release()
    assert pool.count == 3 * 6


def test_a_closed_pool_s_textures_stay_as_long_as_they_are_shown(first: Any, group: ShareGroup) -> None:
    pool = LayerPool(first, group)
    shown, left = written(pool, NOISE), written(pool, NOISE)
    names = [texture.glo for texture in left.textures]
    del left
    pool.close()
    assert not any(is_texture(name) for name in names)
    assert np.array_equal(shown.pixels(), NOISE)
    names = [texture.glo for texture in shown.textures]
    del shown
    gc.collect()
    group.collect()
    assert not any(is_texture(name) for name in names)


def test_of_a_group_that_is_gone_only_what_was_read_before_is_left(first: Any, group: ShareGroup) -> None:
    read, unread = (on_a_thread_of_its_own(group, NOISE) for _ in range(2))
    read.pixels()
    group.close()
    assert (read.lost, unread.lost) == (False, True)
    assert np.array_equal(read.pixels(), NOISE)
    with pytest.raises(ContextLost):
        unread.pixels()


def is_texture(name: int) -> bool:
    import ctypes

    return bool(ctypes.CDLL("libGL.so.1").glIsTexture(ctypes.c_uint(name)))
