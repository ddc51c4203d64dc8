"""What the unrolled solver's steps work on, for one number of channels."""

from __future__ import annotations

from collections.abc import Collection

from runtime.model.chain import ChainFrame
from runtime.model.compiled.level import Level
from runtime.model.resample import buffer
from runtime.optics.rect import PixelRect
from runtime.optics.stack import PanelStack
from runtime.records import I16


class Workspace:
    """Buffers that live from frame to frame; those of the network follow the viewer."""

    def __init__(
        self,
        stack: PanelStack,
        reductions: Collection[int],
        *,
        threads: int,
        channels: int,
    ) -> None:
        self._channels = channels
        self.levels = {r: Level(stack, reduction=r, threads=threads, channels=channels) for r in reductions}
        self._cropped: tuple[tuple[PixelRect, ...], PanelStack] | None = None
        self._chain: tuple[tuple[int, int], tuple[I16, I16]] | None = None

    def crop(self, boxes: tuple[PixelRect, ...], stack: PanelStack) -> None:
        """Cut every raster and buffer to boxes of the panels of a stack of this size."""
        if (boxes, stack) == self._cropped:
            return
        self._cropped = boxes, stack
        for level in self.levels.values():
            level.crop(boxes, stack)

    def chain_buffers(self, frame: ChainFrame) -> tuple[I16, I16]:
        """One image for each eye on the network's raster."""
        size = (frame.rows, frame.width_px)
        if self._chain is None or self._chain[0] != size:
            left, right = (buffer(*size, channels=self._channels) for _ in range(2))
            self._chain = size, (left, right)
        return self._chain[1]
