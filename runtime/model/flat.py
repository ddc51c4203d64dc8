"""The 2D picture that looks right from everywhere: outer panels even, everything on the centre panel."""

from __future__ import annotations

import cv2
import numpy as np

from runtime.model.transfer import SUBCODE, phase_codes
from runtime.optics.stack import PanelStack
from runtime.records import U8


def flat_layers(image: U8, stack: PanelStack) -> U8:
    """(N, h, w, 4) layers that show a picture (h, w, 4), drawn on the middle panel's raster, to every eye."""
    middle = stack.count // 2
    layers = np.full((stack.count, stack.height_px, stack.width_px, 4), 255, np.uint8)
    # On the second branch the sum is at least one panel's range: the other panels share it, and the middle
    # one carries the picture.
    even = 255 // (stack.count - 1)
    layers[..., :3] = even
    phase = cv2.LUT(cv2.cvtColor(image, cv2.COLOR_RGBA2RGB), phase_codes(2))
    rest = np.clip((phase + SUBCODE // 2) // SUBCODE - even * (stack.count - 1), 0, 255).astype(np.uint8)
    layers[middle, ..., :3] = rest
    return layers
