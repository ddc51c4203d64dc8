"""Layers as a model's backend leaves them in textures."""

from __future__ import annotations

import numpy as np

from runtime.records import U8
from runtime.support.gl_sharing import LayerPool, LayerTextures, wait_until_drawn


def written(pool: LayerPool, layers: U8) -> LayerTextures:
    """Layers (N, h, w, 4) in textures of a pool, complete. Its context is current."""
    count, height, width = layers.shape[:3]
    left = pool.taken(count, width_px=width, height_px=height)
    for texture, layer in zip(left.textures, layers, strict=True):
        texture.write(np.ascontiguousarray(layer))
    wait_until_drawn()
    return left
