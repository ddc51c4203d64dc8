"""Interface of content sources, which draw a scene's picture for one eye on a given raster.

`ContentSource` is also the base of user-defined scenes, such as `scene = "mypackage.tunnel:Tunnel"`. A scene must
implement only `render`; the other methods are optimisations, whose defaults are correct for any scene.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from pydantic import BaseModel

from runtime.config import Section
from runtime.optics.rect import PixelRect
from runtime.records import F32, F64, U8

if TYPE_CHECKING:
    from runtime.support.gl import DrawnPicture


Colour = tuple[float, float, float]  # 0-1
WHITE: Colour = (1.0, 1.0, 1.0)


@dataclass(frozen=True, slots=True)
class View:
    """One eye, and the raster on which to draw for it."""

    eye_m: F64  # (3,) frame `stack`
    side: int  # 0: left, 1: right
    pixels_from_stack: F64  # (3, 4) projection; third coordinate in metres, positive in front of the eye
    width_px: int
    height_px: int
    reduction: int = 1  # divisor of the display's rows and columns; outlines keep their width on the display
    display_from_view: F64 | None = None  # 3x3 rotation from the placed scene's frame; the lamp is fixed to the display


@dataclass(frozen=True, slots=True)
class ContentInfo:
    """Static properties of a scene. The solver skips work that they make unnecessary."""

    name: str
    moving: bool = False
    grey: bool = False
    background: Colour | None = WHITE  # uniform colour behind the scene; None: there is none
    flat_x_m: float | None = None  # x of the plane that contains the whole scene, if it is flat
    left_out: tuple[str, ...] = ()  # parts of the file that are not drawn


class ContentSource(ABC):
    """A scene. The thread that owns its GL context creates, uses and closes it."""

    Options: ClassVar[type[BaseModel]] = Section  # options that [content.options] may contain, for user-defined scenes
    info: ContentInfo
    draws_in: object = None  # GL context of its textures; None: it returns arrays

    def __init__(self, options: Any, *, stack: Any, context: Any) -> None:
        """Create a user-defined scene. Raises InputError if it cannot be shown.

        options: an instance of `Options`; stack: the panels (`PanelStack`); context: the current moderngl context.
        """
        self.info = ContentInfo(type(self).__name__, moving=True, background=None)

    @abstractmethod
    def render(self, view: View, *, time_ns: int) -> U8:
        """Return the eye's picture on the view's raster: (height_px, width_px, 4) RGBA, row 0 at the top.

        Colours are already blended with the background. Alpha is the content's coverage; it is 0 only where nothing but
        the background shows. The array belongs to the source and stays valid until the next `render` for the same side.
        time_ns: time on the run's clock, for moving content. If it raises ContentFailure, the last picture stays.
        """

    def draw(self, view: View, *, time_ns: int) -> DrawnPicture | None:
        """Return the picture as a texture, or None if `render` must be used. Raises ContentFailure.

        The texture is valid until the next picture for the same side.
        """
        return None

    def nearness(self, view: View, *, every: int, first: tuple[int, int]) -> F32 | None:
        """Return (h, w) inverse distances, in 1/m, of the nearest points in blocks of the newest picture.

        The picture is the newest one of the view's side, and a distance is the view's third coordinate. The value is 0
        where only the background shows. If the result is None (unknown), content is aligned to new eyes as if it were
        on the middle panel. every: size of a block in pixels; first: number of pixels (right, down), less than
        `every`, that are cut off the first block.
        """
        return None

    def expect(self, views: Sequence[View], *, time_ns: int) -> None:  # noqa: B027 - most have nothing to prepare
        """Prepare for the views of both eyes that will be drawn next. Raises ContentFailure."""

    @property
    def program(self) -> dict[str, Any] | None:
        """Return `address` and recent `frame_ms` if another program draws the scene, otherwise None."""
        return None

    def extent(self, view: View, *, time_ns: int) -> PixelRect | None:
        """Return a box of the view's pixels outside which only the background shows; None: unknown."""
        return None

    def revision(self, *, time_ns: int) -> int:
        """Return a number that changes when `render` may draw the same view differently."""
        return time_ns if self.info.moving else 0

    def describe(self, *, time_ns: int) -> dict[str, Any] | None:
        """Return a playlist's entries, the current one and its remaining time, or None for other sources."""
        return None

    def skip(self, *, time_ns: int) -> bool:
        """Go to the next entry of a playlist. Return False if there is no other."""
        return False

    @property
    def problem(self) -> str:
        """Current fault in one line, during which the last good picture stays; empty if there is none."""
        return ""

    def close(self) -> None:  # noqa: B027 - most sources hold nothing
        """Release GL objects and files. May be called twice."""


class ForwardingSource(ContentSource):
    """Source that shows another source."""

    source: ContentSource  # the source that is currently shown
    _drew: tuple[ContentSource | None, ContentSource | None] = (None, None)  # source of each side's newest picture

    @abstractmethod
    def forwarded(self, view: View, time_ns: int) -> tuple[ContentSource, View, int]:
        """Return the source, view and time to which a request is forwarded."""

    @property
    def problem(self) -> str:
        return self.source.problem

    @property
    def program(self) -> dict[str, Any] | None:
        return self.source.program

    def expect(self, views: Sequence[View], *, time_ns: int) -> None:
        requests = [self.forwarded(view, time_ns) for view in views]
        requests[0][0].expect([view for _, view, _ in requests], time_ns=requests[0][2])

    @property
    def draws_in(self) -> object:  # type: ignore[override]
        return self.source.draws_in

    def draw(self, view: View, *, time_ns: int) -> DrawnPicture | None:
        source, view, time_ns = self._forwarded(view, time_ns)
        return source.draw(view, time_ns=time_ns)

    def render(self, view: View, *, time_ns: int) -> U8:
        source, view, time_ns = self._forwarded(view, time_ns)
        return source.render(view, time_ns=time_ns)

    def nearness(self, view: View, *, every: int, first: tuple[int, int]) -> F32 | None:
        source = self._drew[view.side]
        return None if source is None else source.nearness(view, every=every, first=first)

    def _forwarded(self, view: View, time_ns: int) -> tuple[ContentSource, View, int]:
        forwarded = self.forwarded(view, time_ns)
        left, right = self._drew
        self._drew = (left, forwarded[0]) if view.side else (forwarded[0], right)
        return forwarded

    def extent(self, view: View, *, time_ns: int) -> PixelRect | None:
        source, view, time_ns = self.forwarded(view, time_ns)
        return source.extent(view, time_ns=time_ns)

    def close(self) -> None:
        self.source.close()
