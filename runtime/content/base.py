"""The interface of content sources: the picture of a scene for one eye, in a given raster.

`ContentSource` is also the base of user-defined scenes: `scene = "mypackage.tunnel:Tunnel"`. Of its methods only
`render` must be written; the others are optimisations, whose defaults are right for any scene.
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
    """One eye and the raster that it should be drawn for."""

    eye_m: F64  # (3,) frame `stack`
    side: int  # 0: left, 1: right
    pixels_from_stack: F64  # (3, 4) projection; third coordinate: positive before the eye, metres
    width_px: int
    height_px: int
    reduction: int = 1  # of the display's rows and columns on this raster: outlines keep the width they have there
    display_from_view: F64 | None = None  # 3x3 turn out of a frame that was placed: the lamp is fixed to the display


@dataclass(frozen=True, slots=True)
class ContentInfo:
    """Static properties of a scene; the solver skips work that they make unnecessary."""

    name: str
    moving: bool = False
    grey: bool = False
    background: Colour | None = WHITE  # uniform, behind it; None: none
    flat_x_m: float | None = None  # plane of `stack` that contains all of it; both eyes see the same picture
    left_out: tuple[str, ...] = ()  # content of the file that is not drawn


class ContentSource(ABC):
    """A scene. One thread, the one with its GL context, makes, uses and closes it."""

    Options: ClassVar[type[BaseModel]] = Section  # of a class of the user's own: what [content.options] may hold
    info: ContentInfo
    draws_in: object = None  # the GL context that its textures are in; None: it has arrays

    def __init__(self, options: Any, *, stack: Any, context: Any) -> None:
        """Construct a user-defined scene. Raises InputError if it cannot be shown.

        options: an instance of `Options`; stack: the panels (`PanelStack`); context: moderngl's, current.
        """
        self.info = ContentInfo(type(self).__name__, moving=True, background=None)

    @abstractmethod
    def render(self, view: View, *, time_ns: int) -> U8:
        """Return the eye's picture in the view's raster: (height_px, width_px, 4) RGBA, row 0 at the top.

        Colour is already composed over the background; alpha is the content's coverage: 0 only where nothing
        but the background shows. The array is the source's own: it holds until the next `render` of the same
        side, and the other side's call leaves it alone. `time_ns` is the run's clock, for content that moves.
        Raises ContentFailure: the last picture stays.
        """

    def draw(self, view: View, *, time_ns: int) -> DrawnPicture | None:
        """The picture in a texture, valid until the side's next; None: use `render`. Raises ContentFailure."""
        return None

    def nearness(self, view: View, *, every: int, first: tuple[int, int]) -> F32 | None:
        """(h, w) 1/m: the inverse distance of the nearest point in each block of a view's picture.

        The distance is the view's third coordinate; the picture is the side's newest, of the same raster; 0: only the
        background shows there. None: unknown, and content is aligned to a new eye as if on the middle panel. every:
        pixels of a block, right and down; first: pixels, fewer than those, by which the first block is cut.
        """
        return None

    def expect(self, views: Sequence[View], *, time_ns: int) -> None:  # noqa: B027 - most have nothing to prepare
        """Announce the two eyes' views that will be rendered next. Raises ContentFailure."""

    @property
    def program(self) -> dict[str, Any] | None:
        """`address` and recent `frame_ms` of a scene that another program draws, else None."""
        return None

    def extent(self, view: View, *, time_ns: int) -> PixelRect | None:
        """A box of the view's pixels outside which only the background shows; None: unknown."""
        return None

    def revision(self, *, time_ns: int) -> int:
        """A number that changes whenever `render` may draw the same view differently."""
        return time_ns if self.info.moving else 0

    def describe(self, *, time_ns: int) -> dict[str, Any] | None:
        """Entries of a playlist, the one that is shown and its remaining time; None for any other source."""
        return None

    def skip(self, *, time_ns: int) -> bool:
        """Go to the next one of a playlist; False: there is no other."""
        return False

    @property
    def problem(self) -> str:
        """The current fault while the last good picture stays, in one line; empty without one."""
        return ""

    def close(self) -> None:  # noqa: B027 - most sources hold nothing
        """Release GL objects and files. May be called twice."""


class ForwardingSource(ContentSource):
    """A source that shows another one."""

    source: ContentSource  # that is shown at present
    _drew: tuple[ContentSource | None, ContentSource | None] = (None, None)  # each side's newest picture

    @abstractmethod
    def forwarded(self, view: View, time_ns: int) -> tuple[ContentSource, View, int]:
        """The source, view and time that a request is forwarded to."""

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
        found = self.forwarded(view, time_ns)
        left, right = self._drew
        self._drew = (left, found[0]) if view.side else (found[0], right)
        return found

    def extent(self, view: View, *, time_ns: int) -> PixelRect | None:
        source, view, time_ns = self.forwarded(view, time_ns)
        return source.extent(view, time_ns=time_ns)

    def close(self) -> None:
        self.source.close()
