"""What the eyes really saw of a run's frames, beside what they should have seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from runtime.content.base import ContentSource
from runtime.plan.drawing import retina_view
from runtime.optics.quality import Quality, quality
from runtime.optics.retina import Retina, seen_by
from runtime.optics.stack import PanelStack
from runtime.records import F64, U8


@dataclass(frozen=True, slots=True)
class Look:
    """Both eyes' pictures of one frame."""

    seen: tuple[Retina, Retina]
    wanted: tuple[U8, U8]  # (h, w, 3)
    quality: Quality


class QualityProbe:
    """Measures displayed quality (design 5.5). Slow: for sampled frames, outside the turn's time."""

    def __init__(self, stack: PanelStack, *, fov_deg: float) -> None:
        self._stack, self._fov_deg = stack, fov_deg

    def look(self, layers: U8, content: ContentSource, eyes_m: F64, *, time_ns: int) -> Look:
        """What eyes (2, 3), frame `stack`, see of `layers`, and what `content` shows them.

        Raises ValueError where an eye sees nothing of the panels.
        """
        width, height = self._stack.width_px, self._stack.height_px
        wanted, seen = [], []
        for side, eye in enumerate(eyes_m):
            view = retina_view(eye, side, width_px=width, height_px=height, fov_deg=self._fov_deg)
            wanted.append(content.render(view, time_ns=time_ns)[..., :3].copy())
            seen.append(seen_by(eye, layers, self._stack, fov_deg=self._fov_deg))
        targets = [picture.astype(np.float32) / np.float32(255) for picture in wanted]
        measured = quality([r.image for r in seen], targets, [r.mask for r in seen])
        return Look((seen[0], seen[1]), (wanted[0], wanted[1]), measured)
