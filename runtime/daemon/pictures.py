"""Small pictures of a refresh for the operator's page: its layers, and what each eye sees through them.

What an eye sees is sampled from the layers as they are solved, ray by ray; only so many rays are taken as the picture
has pixels. All four channels are worked on up to the
end, though three are shown: over three the loops of NumPy take thirty times as long.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import cv2
import numpy as np

from runtime.frame.presenter import Refresh
from runtime.optics.alignment import EVEN_CODE, reference_x_m, scale_and_shift
from runtime.optics.malus import intensity_from_phase
from runtime.optics.stack import PanelStack
from runtime.records import F64, U8, PanelFrame, pixels_of

WIDTH_PX = 256
JPEG_QUALITY = 80


def pictures_of(refresh: Refresh, stack: PanelStack, *, width_px: int = WIDTH_PX) -> dict[str, bytes]:
    """JPEGs of a refresh: `layer-0`, ... rear to front, `seen-left`, `seen-right`; none where nothing was shown yet.

    Raises ContextLost where its layers' textures are no more.
    """
    frame, eyes_m = refresh.frame, refresh.account.eyes_m
    if frame.solved is None and frame.flat is None:
        return {}
    width = min(width_px, stack.width_px)
    height = max(1, round(width * stack.height_px / stack.width_px))
    found = {f"layer-{n}": _layer(frame, n, stack, width, height) for n in range(stack.count)}
    if eyes_m is not None:
        for name, eye_m in zip(("seen-left", "seen-right"), eyes_m, strict=True):
            if eye_m[0] > max(stack.x_m):
                found[name] = seen(frame, stack, eye_m, width_px=width, height_px=height)
    return {name: _jpeg(image) for name, image in found.items()}


def seen(frame: PanelFrame, stack: PanelStack, eye_m: F64, *, width_px: int, height_px: int) -> U8:
    """(h, w, 4) what an eye sees of the plane in the stack's middle; black where its ray misses a panel."""
    reference_m = reference_x_m(stack)
    across = (np.arange(width_px) + 0.5) / width_px - 0.5  # shares of the display's size from its middle
    up = 0.5 - (np.arange(height_px) + 0.5) / height_px
    total = np.zeros((height_px, width_px, 4), np.uint16)
    columns, rows = np.ones(width_px, bool), np.ones(height_px, bool)
    for index, x_m in enumerate(stack.x_m):
        # Along the ray from the eye through the reference plane.
        along = (x_m - eye_m[0]) / (reference_m - eye_m[0])
        u = ((eye_m[1] + (across * stack.width_m - eye_m[1]) * along) / stack.width_m + 0.5) * stack.width_px
        v = (0.5 - (eye_m[2] + (up * stack.height_m - eye_m[2]) * along) / stack.height_m) * stack.height_px
        np.add(total, _shown_at(frame, index, u, v), out=total)
        columns &= (u >= 0) & (u < stack.width_px)
        rows &= (v >= 0) & (v < stack.height_px)
    image: U8 = _codes_of_sums(stack.count).take(total)
    image[~rows] = 0
    image[:, ~columns] = 0
    return image


def _shown_at(frame: PanelFrame, index: int, u: F64, v: F64) -> Any:
    """(h, w, 4) codes of a panel where columns u and rows v of its pixels meet; outside the layer it is neutral."""
    su, sv, tu, tv = _alignment(frame, index)
    flatness = 1.0 if frame.solved is None else frame.flatness
    if flatness < 1.0 and frame.solved is not None:
        solved = _sampled(pixels_of(frame.solved)[index], u * su + tu, v * sv + tv)
        if flatness <= 0.0 or frame.flat is None:
            return solved
        return cv2.addWeighted(solved, 1.0 - flatness, _sampled(pixels_of(frame.flat)[index], u, v), flatness, 0.0)
    assert frame.flat is not None
    return _sampled(pixels_of(frame.flat)[index], u, v)


def _sampled(layer: U8, u: F64, v: F64) -> Any:
    """The nearest pixels' codes (h, w, 4)."""
    height, width = layer.shape[:2]
    columns, rows = np.floor(u).astype(np.intp), np.floor(v).astype(np.intp)
    pixels = layer.view(np.uint32).reshape(-1)  # a pixel of four codes is gathered as one number
    picked = pixels.take(rows.clip(0, height - 1)[:, None] * width + columns.clip(0, width - 1))
    codes = picked.view(np.uint8).reshape(*picked.shape, 4)
    codes[(rows < 0) | (rows >= height)] = EVEN_CODE
    codes[:, (columns < 0) | (columns >= width)] = EVEN_CODE
    return codes


@cache
def _codes_of_sums(panels: int) -> U8:
    """What an eye sees, as codes, by the sum of the panels' codes along its ray."""
    sums = np.arange(255 * panels + 1, dtype=np.float64)
    codes: U8 = (intensity_from_phase(sums / 255.0) * 255.0 + 0.5).astype(np.uint8)
    return codes


def _layer(frame: PanelFrame, index: int, stack: PanelStack, width: int, height: int) -> U8:
    """(h, w, 4) a panel's picture as it is shown; each pixel is the mean of four of the layer's."""
    u = (np.arange(2 * width) + 0.5) / (2 * width) * stack.width_px
    v = (np.arange(2 * height) + 0.5) / (2 * height) * stack.height_px
    small: Any = cv2.resize(_shown_at(frame, index, u, v), (width, height), interpolation=cv2.INTER_AREA)
    image: U8 = small
    return image


def _alignment(frame: PanelFrame, index: int) -> tuple[float, float, float, float]:
    if not frame.solved_from_shown:
        return 1.0, 1.0, 0.0, 0.0
    return scale_and_shift(frame.solved_from_shown[index])


def _jpeg(image: U8) -> bytes:
    """Of an (h, w, 4) picture, without its fourth channel."""
    blue_first = cv2.cvtColor(image, cv2.COLOR_RGBA2BGR)
    done, coded = cv2.imencode(".jpg", blue_first, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not done:
        raise ValueError("JPEG encoding failed")
    return coded.tobytes()
