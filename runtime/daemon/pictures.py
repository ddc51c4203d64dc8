"""Small pictures of a refresh for the operator's page: its layers, and what each eye sees through them."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from runtime.frame.presenter import Refresh
from runtime.optics.retina import seen_by
from runtime.optics.stack import PanelStack
from runtime.records import U8, pixels_of

WIDTH_PX = 256
JPEG_QUALITY = 80


def pictures_of(refresh: Refresh, stack: PanelStack, *, fov_deg: float) -> dict[str, bytes]:
    """JPEGs of a refresh: `layer-0`, ... rear to front, `seen-left`, `seen-right`; none where nothing was shown yet.

    Layers are as they were solved, made small, and seen from the eyes that they were solved for: what is exact would
    cost more than a refresh. Raises ContextLost where the layers' textures are no more.
    """
    frame, account = refresh.frame, refresh.account
    is_flat = frame.solved is None or (frame.flat is not None and frame.flatness > 0.5)
    shown, eyes_m = (frame.flat, account.eyes_m) if is_flat else (frame.solved, account.solved_for_m)
    if shown is None:
        return {}
    width = min(WIDTH_PX, stack.width_px)
    small = replace(stack, width_px=width, height_px=max(1, round(width * stack.height_px / stack.width_px)))
    size = small.width_px, small.height_px
    part = slice(None, None, max(1, stack.width_px // (2 * width)))  # twice as fine: averaging all pixels takes 15 ms
    parts = (np.ascontiguousarray(layer[part, part]) for layer in pixels_of(shown))
    resized = [cv2.resize(layer, size, interpolation=cv2.INTER_AREA) for layer in parts]
    layers: U8 = np.stack(resized).astype(np.uint8, copy=False)
    found = {f"layer-{n}": _jpeg(layer) for n, layer in enumerate(layers)}
    for name, eye_m in zip(("seen-left", "seen-right"), () if eyes_m is None else eyes_m, strict=False):
        if eye_m[0] > max(stack.x_m):
            seen = seen_by(eye_m, layers, small, fov_deg=fov_deg)
            found[name] = _jpeg(np.rint(255 * seen.image * seen.mask[..., None]).astype(np.uint8))
    return found


def _jpeg(image: U8) -> bytes:
    """Of an (h, w, 3 or 4) picture, without its fourth channel."""
    done, coded = cv2.imencode(".jpg", image[..., 2::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not done:
        raise ValueError("JPEG encoding failed")
    return coded.tobytes()
