"""Layers as a solver leaves them: in textures, by a thread with a context of its own."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from runtime.records import U8
from runtime.support.gl_sharing import LayerPool, LayerTextures, ShareGroup, wait_until_drawn

T = TypeVar("T")


def in_a_thread(work: Callable[[], T]) -> T:
    """What a call answers on a thread that ends with it; raises what it raises."""
    found: list[T] = []
    errors: list[BaseException] = []

    def run() -> None:
        try:
            found.append(work())
        except BaseException as error:
            errors.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    if errors:
        raise errors[0]
    return found[0]


def on_a_thread_of_its_own(group: ShareGroup, layers: U8) -> LayerTextures:
    """Layers (N, h, w, 4) left in textures of a group; the context that drew them is gone by then."""

    def work() -> LayerTextures:
        context = group.context()
        left = written(LayerPool(context, group), layers)
        context.release()
        return left

    return in_a_thread(work)


def written(pool: LayerPool, layers: U8) -> LayerTextures:
    """Layers in textures of a pool, complete. Its context is current."""
    count, height, width = layers.shape[:3]
    left = pool.taken(count, width_px=width, height_px=height)
    for texture, layer in zip(left.textures, layers, strict=True):
        texture.write(np.ascontiguousarray(layer))
    wait_until_drawn()
    return left


__all__: list[Any] = ["in_a_thread", "on_a_thread_of_its_own", "written"]
