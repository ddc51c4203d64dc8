"""What every content source answers: what does an eye at this pose see, in these pixels?"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

from runtime.records import F64, U8


@dataclass(frozen=True, slots=True)
class View:
    """One eye and the raster that it should be drawn for."""

    eye_m: F64  # (3,) frame `stack`
    side: int  # 0: left, 1: right
    pixels_from_stack: F64  # (3, 4) projection; third coordinate: positive before the eye, metres
    width_px: int
    height_px: int


@dataclass(frozen=True, slots=True)
class ContentInfo:
    """What a source knows about itself; the plan leaves out what this says is not needed."""

    name: str
    moving: bool = False
    grey: bool = False
    depth_range_m: tuple[float, float] | None = None  # nearest to farthest along +x of `stack`: (rear, front)
    background: tuple[float, float, float] | None = (1.0, 1.0, 1.0)  # uniform colour behind it, 0-1; None: none


class ContentSource(ABC):
    """A scene, a picture or another program's pictures."""

    info: ContentInfo

    @abstractmethod
    def render(self, view: View, *, time_ns: int) -> U8:
        """What the eye sees in the view's raster: (height_px, width_px, 4) RGBA, straight alpha.

        Alpha is 255 where there is content and 0 where only the (already filled in) background shows.
        `time_ns` is the run's clock, for content that moves. Raises ContentFailure: the last picture stays.
        """

    def close(self) -> None:  # noqa: B027 - most sources hold nothing
        """Release GL objects and files. May be called twice."""
