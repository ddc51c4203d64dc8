"""Show pictures, folders of pictures and videos on the centre panel, with a view for each eye."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from runtime.content.base import ContentInfo, ContentSource, View
from runtime.content.comfort import DepthLimit
from runtime.content.frames import Frames, PictureFiles, open_frames
from runtime.content.images import WarpedPicture, plane_from_pixels, rgba_from_rgb
from runtime.content.layout import Layout
from runtime.content.placing import SceneFile
from runtime.errors import ContentFailure, InputError
from runtime.optics.stack import PanelStack, PlaneRaster
from runtime.records import F64, U8

SLIDES_HZ = 2.0  # a folder of pictures that change more slowly is no film


def screen(stack: PanelStack, *, width_px: int, height_px: int, pixel_aspect: float = 1.0) -> PlaneRaster:
    """Return a picture's grid, of pixels with this width / height, on x = 0, fitted to the display."""
    pitch_m = min(stack.width_m / (width_px * pixel_aspect), stack.height_m / height_px)
    return PlaneRaster(
        x_m=0.0,
        left_m=-pitch_m * pixel_aspect * width_px / 2,
        top_m=pitch_m * height_px / 2,
        pitch_u_m=pitch_m * pixel_aspect,
        pitch_v_m=pitch_m,
        width_px=width_px,
        height_px=height_px,
    )


class ShownViews:
    """Views of one picture on the plane through the display's centre, ready to be warped."""

    def __init__(self, views: list[U8], layout: Layout, file: SceneFile) -> None:
        height, width = views[0].shape[:2]
        aspect = layout.pixel_aspect(width_px=width, height_px=height)
        self.views, self._background = views, file.background
        self.screen = screen(file.stack, width_px=width, height_px=height, pixel_aspect=aspect)
        self._warped: dict[int, WarpedPicture] = {}

    def from_view(self, view: View) -> F64 | None:
        """Return the 3x3 homography from an eye's view to the views' pixels, or None if the eye is in
        their plane.
        """
        return plane_from_pixels(view.pixels_from_stack, self.screen)

    def within(self, limit: DepthLimit, number: int, view: View) -> F64 | None:
        """Return the homography of `from_view` for the picture of this number, within a limit of depth."""
        return limit.moved(self.from_view(view), view, number=number, pictures=self.views, screen=self.screen)

    def warped(self, number: int, picture_from_view: F64 | None, view: View) -> U8:
        """Return a view warped to an eye's raster, as `WarpedPicture` does."""
        if number not in self._warped:
            self._warped[number] = WarpedPicture(rgba_from_rgb(self.views[number]), background=self._background)
        return self._warped[number].warped(picture_from_view, view)


def prepare(file: SceneFile) -> Callable[..., ContentSource]:
    """Open a picture, a video or a folder of pictures, and return a function that creates the source.
    Raises InputError if the file cannot be shown, or if its first picture is too small for its layout.
    """
    frames = open_frames(file.path, file.settings)
    make = partial(PicturesSource, frames, file=file)
    make()  # raises now if the first picture is too small for its layout
    return make


class PicturesSource(ContentSource):
    """Source that shows pictures or a film on the centre panel's plane, with a view for each eye."""

    def __init__(self, frames: Frames, *, file: SceneFile, context: object = None) -> None:
        """Create the source. Raises InputError if the first picture is too small for its layout."""
        self._frames, self._file = frames, file
        is_slow = isinstance(frames, PictureFiles) and frames.rate_hz < SLIDES_HZ
        self._limit = DepthLimit(follows=not is_slow)
        first = frames.frame(0)
        try:
            self._take(0, first)
        except ValueError as error:
            raise InputError(file.path, "layout", str(error)) from None
        moving, mono = frames.count > 1, all(layout.kind == "mono" for layout in frames.layouts)
        self.info = ContentInfo(
            name=file.path.stem,
            moving=moving,
            grey=not moving and _is_grey(first),
            background=file.background,
            flat_x_m=0.0 if mono else None,
            fixed_views=True,
        )

    def render(self, view: View, *, time_ns: int) -> U8:
        number = self.revision(time_ns=time_ns)
        if number != self._at:
            try:
                self._take(number, self._frames.frame(number))
            except ValueError as error:
                raise ContentFailure(f"{self.info.name}: {error}") from None
        return self._shown.warped(self._view_for(view), self._shown.within(self._limit, number, view), view)

    def _take(self, number: int, picture: U8) -> None:
        """Split a picture into views, and show these now. Raises ValueError if it is too small for its layout."""
        layout = self._frames.layout(number)
        self._shown, self._at = ShownViews(layout.views(picture), layout, self._file), number

    def _view_for(self, view: View) -> int:
        """Return the index of the view that an eye sees: by its side in a stereo picture, by its angle in a quilt."""
        count = len(self._shown.views)
        if count <= 2:
            return min(view.side, count - 1)
        angle = np.arctan2(view.eye_m[1], view.eye_m[0])
        place = (angle / np.radians(self._file.settings.cone_deg) + 0.5) * (count - 1)
        return int(np.clip(np.rint(place), 0, count - 1))

    def revision(self, *, time_ns: int) -> int:
        return self._frames.at(time_ns)

    def close(self) -> None:
        self._frames.close()


def _is_grey(rgb: U8) -> bool:
    small = rgb[::4, ::4].astype(np.int16)
    return bool((np.ptp(small, axis=2) <= 2).all())
