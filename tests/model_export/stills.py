"""Random pairs as pictures of two eyes, for checks over the whole design range. Needs no torch."""

from __future__ import annotations

import numpy as np

from model_export.data import random_pair
from runtime.report.pairs import StillPair


def random_still(seed: int, number: int, *, width_px: int, height_px: int) -> StillPair:
    """Pair `number` of a seed's endless row, made from these two alone."""
    pair = random_pair(np.random.default_rng([seed, number]), width_px=width_px, height_px=height_px)
    return StillPair(f"{seed}-{number}", pair.stack, pair.eyes_m, pair.images, pair.fov_deg)
