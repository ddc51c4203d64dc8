"""The phase sums that pictures ask for: compiled, they are OpenCV's."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from runtime.model import wanted
from runtime.model.compiled import wanted as compiled
from runtime.model.resample import buffer
from runtime.model.transfer import phase_codes
from runtime.optics.rect import PixelRect
from runtime.records import I16

BOXES = {
    "whole": PixelRect(0, 0, 64, 36),
    "a part": PixelRect(4, 3, 58, 33),
    "odd sizes": PixelRect(3, 1, 60, 30),
    "two rows": PixelRect(0, 5, 64, 7),
    "one column": PixelRect(7, 0, 8, 36),
}


def images(box: PixelRect, *, reduction: int, channels: int) -> list[I16]:
    size = max(1, box.height_px // reduction), max(1, box.width_px // reduction)
    return [buffer(*size, channels=channels) for _ in range(2)]


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("emphasis", [0.0, 0.1])
@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("box", BOXES)
@pytest.mark.parametrize("reductions", [(1,), (1, 2), (1, 2, 4)])
def test_compiled_phase_sums_are_those_of_opencv(
    box: str, channels: int, emphasis: float, threads: int, reductions: tuple[int, ...]
) -> None:
    noise = np.random.default_rng(3).integers(0, 256, (2, 36, 64, 4)).astype(np.uint8)
    if channels == 1:
        noise[..., 1:] = noise[..., :1]
    pictures = wanted.Pictures(list(noise), BOXES[box], channels, emphasis, phase_codes(2))
    found = []
    for fill in (wanted.fill_targets, partial(compiled.fill_targets, threads=threads)):
        pairs = [images(BOXES[box], reduction=reduction, channels=channels) for reduction in reductions]
        fill(pictures, pairs)
        found.append([image.copy() for pair in pairs for image in pair])
    for theirs, ours in zip(*found, strict=True):
        # A code exactly between two may be rounded either way, which is worth a step of the table.
        assert np.count_nonzero(theirs != ours) <= max(4, 0.005 * ours.size)
        assert np.abs(theirs.astype(int) - ours).max() <= 300
