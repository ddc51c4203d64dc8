"""Small pictures of a refresh for the operator's page: its layers, and what each eye sees through them.

Only so many rays are taken as a picture has pixels. All four channels are worked on up to the end, though three are
shown: over three the loops of NumPy take thirty times as long.
"""

from __future__ import annotations

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
NEAREST = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
Line = tuple[float, float]  # from a small picture's pixels to places on a panel: factor, and the first one's place


def pictures_of(refresh: Refresh, stack: PanelStack, *, width_px: int = WIDTH_PX) -> dict[str, bytes]:
    """JPEGs of a refresh: `layer-0`, ... rear to front, `seen-left`, `seen-right`; none where nothing was shown yet.

    Raises ContextLost where its layers' textures are no more.
    """
    frame, eyes_m = refresh.frame, refresh.account.eyes_m
    if frame.solved is None and frame.flat is None:
        return {}
    width = min(width_px, stack.width_px)
    size = width, max(1, round(width * stack.height_px / stack.width_px))
    found = {f"layer-{n}": _layer(frame, n, stack, size) for n in range(stack.count)}
    if eyes_m is not None:
        for name, eye_m in zip(("seen-left", "seen-right"), eyes_m, strict=True):
            if eye_m[0] > max(stack.x_m):
                found[name] = seen(frame, stack, eye_m, size)
    return {name: _jpeg(image) for name, image in found.items()}


def seen(frame: PanelFrame, stack: PanelStack, eye_m: F64, size: tuple[int, int]) -> U8:
    """(h, w, 4) what an eye sees of the plane in the stack's middle; black where its ray misses a panel."""
    width, height = size
    reference_m = reference_x_m(stack)
    total = np.zeros((height, width, 4), np.uint16)
    columns, rows = np.ones(width, bool), np.ones(height, bool)
    for index, x_m in enumerate(stack.x_m):
        along = (x_m - eye_m[0]) / (reference_m - eye_m[0])  # the ray from the eye through the reference plane
        u = _line(stack.width_px, width, along, eye_m[1] / stack.width_m)
        v = _line(stack.height_px, height, along, -eye_m[2] / stack.height_m)
        np.add(total, _shown_at(frame, index, u, v, size), out=total)
        columns &= _is_on(u, stack.width_px, width)
        rows &= _is_on(v, stack.height_px, height)
    codes = intensity_from_phase(np.arange(255 * stack.count + 1) / 255.0) * 255.0 + 0.5
    image: U8 = codes.astype(np.uint8).take(total)
    image[~rows] = 0
    image[:, ~columns] = 0
    return image


def _line(panel_px: int, count: int, along: float = 1.0, eye: float = 0.0) -> Line:
    """Where rays through `count` pixels' middles meet a panel. eye: from the panel's middle, by the panel's size."""
    factor = along * panel_px / count
    return factor, 0.5 * factor + (0.5 - 0.5 * along + eye * (1.0 - along)) * panel_px


def _is_on(line: Line, panel_px: int, count: int) -> Any:
    places = line[0] * np.arange(count) + line[1]
    return (places >= 0) & (places < panel_px)


def _shown_at(frame: PanelFrame, index: int, u: Line, v: Line, size: tuple[int, int]) -> Any:
    """(h, w, 4) codes of a panel where columns u and rows v of its pixels meet; outside the layer it is neutral."""
    flatness = 1.0 if frame.solved is None else frame.flatness
    if flatness < 1.0 and frame.solved is not None:
        su, sv, tu, tv = scale_and_shift(frame.solved_from_shown[index]) if frame.solved_from_shown else (1, 1, 0, 0)
        layer = pixels_of(frame.solved)[index]
        solved = _sampled(layer, (u[0] * su, u[1] * su + tu), (v[0] * sv, v[1] * sv + tv), size)
        if flatness <= 0.0 or frame.flat is None:
            return solved
        flat = _sampled(pixels_of(frame.flat)[index], u, v, size)
        return cv2.addWeighted(solved, 1.0 - flatness, flat, flatness, 0.0)
    assert frame.flat is not None
    return _sampled(pixels_of(frame.flat)[index], u, v, size)


def _sampled(layer: U8, u: Line, v: Line, size: tuple[int, int]) -> Any:
    """The nearest pixels' codes (h, w, 4)."""
    matrix = np.array([[u[0], 0.0, u[1] - 0.5], [0.0, v[0], v[1] - 0.5]])
    return cv2.warpAffine(layer, matrix, size, flags=NEAREST, borderValue=(EVEN_CODE,) * 4)


def _layer(frame: PanelFrame, index: int, stack: PanelStack, size: tuple[int, int]) -> U8:
    """(h, w, 4) a panel's picture as it is shown; each pixel is the mean of four of the layer's."""
    width, height = 2 * size[0], 2 * size[1]
    u, v = _line(stack.width_px, width), _line(stack.height_px, height)
    small: Any = cv2.resize(_shown_at(frame, index, u, v, (width, height)), size, interpolation=cv2.INTER_AREA)
    image: U8 = small
    return image


def _jpeg(image: U8) -> bytes:
    """Of an (h, w, 4) picture, without its fourth channel."""
    blue_first = cv2.cvtColor(image, cv2.COLOR_RGBA2BGR)
    done, coded = cv2.imencode(".jpg", blue_first, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not done:
        raise ValueError("JPEG encoding failed")
    return coded.tobytes()
