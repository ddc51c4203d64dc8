"""Inputs of the official code for its golden arrays: weights, pictures and eyes by formula.

`golden-eyereal.npz` holds what the official forward (WeijieMax/EyeReal, commit d19f4a8, on torch 2.13 and torchvision
0.29, run once on 21 November 2026) made of these: `<place>_x` its 18 input channels (times 65535), `<place>_y` its
answer (9, h, w), `<place>_layers` the grey levels (3, h, w, 3) that its inference writes.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from runtime.records import F32, U8

FILE = Path(__file__).with_name("golden-eyereal.npz")
WIDTH = 4  # of the network
SIZE = (64, 40)  # columns, rows: 40 halves to 1 and is padded on one side only on its way back
# In the scene's digital units (0.083 a centimetre), as the data set's names have them; `_0` is the right eye.
EYES = {
    "usual": ((6.487, 0.237, 2.004), (6.486, -0.263, 2.004)),  # 0.82 m: the panels' corners are beyond 40 degrees
    "near": ((4.0, 0.6, 0.8), (4.05, 0.1, 0.8)),  # 0.5 m: much of the panels is
}


def picture(number: int) -> U8:
    """(h, w, 3) picture `_0` or `_1`: smooth, unlike under any mirroring, exchange of colours or of eyes."""
    v, u = np.mgrid[0 : SIZE[1], 0 : SIZE[0]].astype(np.float64) / SIZE[0]
    channels = [0.55 + 0.4 * np.sin(a * u + b * v + c + number) for a, b, c in ((5, 3, 0), (9, -4, 1), (2, 8, 2))]
    return np.asarray(np.rint(np.clip(np.stack(channels, axis=-1), 0, 1) * 255), np.uint8)


def weights(shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Any]:
    """Every entry of a state_dict, by its key's place in the alphabet."""
    found: dict[str, Any] = {}
    for number, key in enumerate(sorted(shapes)):
        random, shape = np.random.default_rng([7, number]), shapes[key]
        if key.endswith("num_batches_tracked"):
            found[key] = np.array(3, np.int64)
        elif key.endswith("running_var"):
            found[key] = random.uniform(0.3, 1.0, shape).astype(np.float32)
        elif key.endswith(("running_mean", "bias")):
            found[key] = random.normal(0, 0.2, shape).astype(np.float32)
        elif len(shape) == 4:
            spread = (2 / (shape[1] * shape[2] * shape[3])) ** 0.5
            found[key] = (random.normal(0, spread, shape) * (16.0 if shape[2] == 1 else 1.0)).astype(np.float32)
        else:
            found[key] = random.uniform(0.7, 1.3, shape).astype(np.float32)
    return found


def golden(name: str) -> F32:
    """One of the arrays; input channels as intensities."""
    with np.load(FILE) as arrays:
        found = arrays[name]
    return np.asarray(found / 65535 if found.dtype == np.uint16 else found, np.float32)
