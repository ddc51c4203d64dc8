"""What the eyes really saw of a run's frames, beside what they should have seen."""

from __future__ import annotations

from collections.abc import Sequence

from runtime.content.base import ContentSource
from runtime.evaluation.displayed import Look, displayed, wanted_pictures
from runtime.optics.carried import carried_quality
from runtime.optics.quality import Quality
from runtime.optics.stack import PanelStack
from runtime.records import F64, U8

__all__ = ["Look", "QualityProbe"]


class QualityProbe:
    """Measures displayed quality (design 5.5). Slow: for sampled frames, outside the turn's time."""

    def __init__(self, stack: PanelStack, *, fov_deg: float) -> None:
        self._stack, self.fov_deg = stack, fov_deg

    def look(self, layers: U8, content: ContentSource, eyes_m: F64, *, time_ns: int) -> Look:
        """What eyes (2, 3), frame `stack`, see of `layers`, and what `content` shows them.

        Raises ValueError where an eye sees nothing of the panels.
        """
        wanted = self.drawn(content, eyes_m, time_ns=time_ns)
        return displayed(layers, wanted, self._stack, eyes_m=eyes_m, fov_deg=self.fov_deg)

    def drawn(self, content: ContentSource, eyes_m: F64, *, time_ns: int) -> tuple[U8, U8]:
        """(h, w, 3) the retina pictures of eyes (2, 3): what `carried` compares with."""
        return wanted_pictures(content, eyes_m, self._stack, fov_deg=self.fov_deg, time_ns=time_ns)

    def carried(self, layers: U8, drawn: Sequence[U8], *, solved_for_m: F64, eyes_m: F64, step: int = 1) -> Quality:
        """Quality at eyes (2, 3) against the pictures of the eyes that the layers were solved for.

        Raises ValueError as `look`. See `optics.carried.carried_quality`.
        """
        return carried_quality(
            layers, drawn, self._stack, solved_for_m=solved_for_m, eyes_m=eyes_m, fov_deg=self.fov_deg, step=step
        )
