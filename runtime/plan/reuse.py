"""How far eyes have moved, as the panels show it. No clock, no I/O."""

from __future__ import annotations

import numpy as np

from runtime.records import F64


def lateral_shift_m(eyes_m: F64, other_m: F64) -> float:
    """How far two eye positions (2, 3) differ as the panels show it, metres at the first eyes' distance; the worse eye.

    What an eye sees depends on the slopes y/x and z/x of its rays: a step straight towards the display counts
    only as far as it changes them.
    """
    slopes, others = eyes_m[:, 1:] / eyes_m[:, :1], other_m[:, 1:] / other_m[:, :1]
    return float((np.linalg.norm(slopes - others, axis=1) * eyes_m[:, 0]).max())
