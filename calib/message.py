"""Words on the panels: on the middle one, the others clear, so that they are read from the front without a terminal."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import wrap

import cv2
import numpy as np

from runtime.optics.stack import PanelStack
from runtime.records import U8

FONT = cv2.FONT_HERSHEY_SIMPLEX
CHARACTERS_MOST = 44  # of a line: longer ones would be too small to read from where viewers stand
MARGIN = 0.1  # of the width on either side: the rims of panels before and behind take light away
LARGEST_SHARE = 0.055  # of the height, a line's letters


def message_layers(stack: PanelStack, lines: Sequence[str]) -> U8:
    """(N, H, W, 4) layers with lines of text; the first one larger."""
    layers = np.zeros((stack.count, stack.height_px, stack.width_px, 4), np.uint8)
    layers[..., 3] = 255
    page = np.zeros((stack.height_px, stack.width_px), np.uint8)
    plain = [part for line in lines for part in wrap(line.encode("ascii", "replace").decode(), CHARACTERS_MOST)]
    room = stack.height_px / max(len(plain) + 2, 9)
    for number, line in enumerate(plain):
        (long, tall), _ = cv2.getTextSize(line, FONT, 1.0, 2)
        height = LARGEST_SHARE * stack.height_px * (1.4 if number == 0 else 1.0)
        scale = min(height / tall, (1 - 2 * MARGIN) * stack.width_px / max(long, 1), 0.55 * room / tall)
        place = (round(MARGIN * stack.width_px), round(room * (number + 1.5)))
        cv2.putText(page, line, place, FONT, scale, 255, max(1, round(2 * scale)), cv2.LINE_AA)
    layers[stack.count // 2, ..., :3] = page[..., None]
    return layers
