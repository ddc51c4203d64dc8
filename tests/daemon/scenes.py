"""Scene whose drawing does harm on request, for a solver in its own process."""

from __future__ import annotations

import ctypes
import time
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from runtime.config import Section
from runtime.content.base import ContentInfo, ContentSource, View
from runtime.errors import ContextLost
from tests.deeds import DEEDS


def _grow() -> None:
    """Take 640 MiB, which is less than what makes Python raise MemoryError, and keep it."""
    kept = [np.ones(1 << 23) for _ in range(10)]
    ctypes.CDLL(None).sleep(3600)
    del kept


def _lose_context() -> None:
    raise ContextLost("the driver reset the GPU")


SCENE_DEEDS = DEEDS | {"grow": _grow, "lose": _lose_context, "nap": lambda: time.sleep(2.5)}


class HarmfulOptions(Section):
    """Options of `Harmful`."""

    file: str = Field("", description="file with the deed, which is deleted before it is done")
    making: bool = Field(False, description="also do the deed while the scene is loaded")


class Harmful(ContentSource):
    """Stripes that move, until the file says what to do."""

    Options = HarmfulOptions

    def __init__(self, options: HarmfulOptions, *, stack: Any, context: Any) -> None:
        self.info = ContentInfo("harmful", moving=True, background=None)
        self._file = Path(options.file)
        if options.making:
            self._do()

    def render(self, view: View, *, time_ns: int) -> np.ndarray:
        if view.width_px > 32:  # not the trial picture
            self._do()
        picture = np.full((view.height_px, view.width_px, 4), 255, np.uint8)
        picture[:, (time_ns // 10_000_000 + view.side) % 7 :: 7, :3] = 60
        return picture

    def _do(self) -> None:
        if self._file.name and self._file.exists():
            deed = self._file.read_text(encoding="utf-8").strip()
            self._file.unlink()
            SCENE_DEEDS[deed]()
