"""Interface for content sources, which draw a scene as seen by one eye on a given pixel grid.

`ContentSource` is also the base class for user-defined scenes, such as `scene = "mypackage.tunnel:Tunnel"`. A scene
only has to implement `render`. The other methods are optimisations, and their defaults are correct for any scene.
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
    """An eye, and the raster to draw its picture on."""

    eye_m: F64  # (3,) position in the frame of the source that is asked: `stack` for the outermost
    side: int  # 0 is the left eye, 1 the right eye
    # (3, 4) projection. The third coordinate is the distance in front of the eye in metres: along x for a raster's
    # pixels, along the gaze for an eye's image.
    pixels_from_stack: F64
    width_px: int
    height_px: int
    reduction: int = 1  # display pixels per raster pixel, in each direction; outlines keep their width on the display
    display_from_view: F64 | None = None  # 3x3 rotation of a moved scene; the lamp is fixed to the display
    comfort_deg: float = 0.0  # limit for the depth of stereo pictures; 0 for none


@dataclass(frozen=True, slots=True)
class ContentInfo:
    """Static properties of a scene. The solver uses them to decide which work it can skip."""

    name: str
    moving: bool = False
    grey: bool = False
    background: Colour | None = WHITE  # uniform colour behind the scene, or None if the background is not uniform
    flat_x_m: float | None = None  # x coordinate of the plane that contains the whole scene, or None if not flat
    left_out: tuple[str, ...] = ()  # features in the file that are not drawn
    fixed_views: bool = False  # True if no pictures can be drawn for other points of a pupil


class ContentSource(ABC):
    """Scene that can be drawn for any eye position, on the one thread that owns its GL context."""

    Options: ClassVar[type[BaseModel]] = Section  # model that validates [content.options] for a user-defined scene
    info: ContentInfo
    draws_in: object = None  # GL context that owns the textures `draw` returns, or None if the source returns arrays

    def __init__(self, options: Any, *, stack: Any, context: Any) -> None:
        """Create a scene, given its `Options` and the display's `PanelStack`. Raises InputError."""
        self.info = ContentInfo(type(self).__name__, moving=True, background=None)

    @abstractmethod
    def render(self, view: View, *, time_ns: int) -> U8:
        """Return the eye's picture on the view's raster as an RGBA array (height_px, width_px, 4), row 0 at
        the top.

        Colours are already blended with the background. Alpha is the content's coverage and is 0 only where nothing but
        the background is visible. The caller may not change the array, which is valid until the next call for the same
        side. `time_ns` is on the run's clock and determines the state of moving content. Raises ContentFailure if the
        picture cannot be drawn at the moment; the last picture then stays on the display.
        """

    def draw(self, view: View, *, time_ns: int) -> DrawnPicture | None:
        """Return the picture as a texture, valid until the next for the same side, or None if the caller must
        use `render`. Raises ContentFailure if the picture cannot be drawn at the moment.
        """
        return None

    def nearness(self, view: View, *, every: int, first: tuple[int, int]) -> F32 | None:
        """Return each pixel block's inverse distance to its nearest point, in 1/m, 0 for the background.

        The shape is (ceil((height_px + first[1]) / every), ceil((width_px + first[0]) / every)). The distances belong
        to the latest picture drawn for the view's side, and are measured along the third coordinate of the view's
        projection. Blocks are squares of `every` pixels; `first` columns and rows, less than `every`, are missing from
        the first one. None if the distances are unknown: content is then aligned as if it were on the middle panel.
        """
        return None

    def expect(self, views: Sequence[View], *, time_ns: int) -> None:  # noqa: B027 - most have nothing to prepare
        """Prepare for the views to be drawn next, usually one per eye. Raises ContentFailure for now."""

    @property
    def program(self) -> dict[str, Any] | None:
        """Return a drawing program's `address` and recent `frame_ms`, or None without a program."""
        return None

    def extent(self, view: View, *, time_ns: int) -> PixelRect | None:
        """Return a pixel box that contains everything visible except the background, or None if unknown."""
        return None

    def revision(self, *, time_ns: int) -> int:
        """Return a number that changes whenever `render` might draw the same view differently."""
        return time_ns if self.info.moving else 0

    def describe(self, *, time_ns: int) -> dict[str, Any] | None:
        """Return a playlist's entries and current position, or None if the source is not a playlist."""
        return None

    def skip(self, *, time_ns: int) -> bool:
        """Skip to the next entry of the playlist. Returns False if no entry follows."""
        return False

    @property
    def problem(self) -> str:
        """Describe the current fault in one line, or return "". The last good picture stays."""
        return ""

    def close(self) -> None:  # noqa: B027 - most sources hold nothing
        """Release GL objects and files. May be called more than once."""


class ForwardingSource(ContentSource):
    """Source that forwards every request to another source, chosen by the subclass."""

    source: ContentSource  # source currently shown
    _drew: tuple[ContentSource | None, ContentSource | None] = (None, None)  # source of each side's latest picture

    @abstractmethod
    def forwarded(self, view: View, time_ns: int) -> tuple[ContentSource, View, int]:
        """Return the source that serves a request, and the view and time to pass to it."""

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

    def revision(self, *, time_ns: int) -> int:
        return self.source.revision(time_ns=time_ns)

    def describe(self, *, time_ns: int) -> dict[str, Any] | None:
        return self.source.describe(time_ns=time_ns)

    def skip(self, *, time_ns: int) -> bool:
        return self.source.skip(time_ns=time_ns)

    def close(self) -> None:
        self.source.close()
