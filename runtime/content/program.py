"""Pictures drawn on request by another program, such as a renderer or a game (docs/programs.md)."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from runtime.config import Section, validated
from runtime.content.base import ContentInfo, ContentSource, View
from runtime.content.camera import clip_from_stack
from runtime.content.placing import SceneFile
from runtime.content.program_link import Server
from runtime.content.program_pictures import SIDES, AskedViews, ProgramPicture
from runtime.content.program_serving import acquire, release
from runtime.errors import ContentFailure
from runtime.records import F32, U8

NEAR_M, FAR_M = 0.05, 100.0


class ProgramOptions(Section):
    """Options in [content.options] for the scene `program`."""

    port: int = Field(0, ge=0, le=65535, description="TCP port to listen on (0 for any free port)")


def prepare(file: SceneFile) -> Callable[[Any], ContentSource]:
    """Start listening for drawing programs, and return a function that creates the source. Raises
    InputError if the options are invalid or the port cannot be opened.
    """
    options = validated(ProgramOptions, file.settings.options, source="content.options")
    display_m = file.stack.width_m, file.stack.height_m
    source = ProgramSource(acquire(options.port), display_m=display_m, background=file.background)
    return lambda context: source


def camera_of(view: View) -> dict[str, Any]:
    """Describe a view, in the form sent to programs: the eye's side and position, and view and projection
    matrices. Matrices are column-major lists for OpenGL, lengths in metres, depth in [-1, 1].
    """
    pixels = view.pixels_from_stack
    forward = pixels[2, :3] / np.linalg.norm(pixels[2, :3])
    right, down = (row[:3] - (row[:3] @ forward) * forward for row in pixels[:2])
    camera = np.eye(4)
    camera[:3, :3] = [right / np.linalg.norm(right), -down / np.linalg.norm(down), -forward]
    camera[:3, 3] = -camera[:3, :3] @ view.eye_m
    clip = clip_from_stack(view, near_m=NEAR_M, far_m=FAR_M)
    clip[1] *= -1  # programs draw with +y up
    matrices = {"view": camera, "projection": clip @ np.linalg.inv(camera)}
    return {"eye": SIDES[view.side], "eye_m": view.eye_m.tolist()} | {
        k: m.T.ravel().tolist() for k, m in matrices.items()
    }


class ProgramSource(ContentSource):
    """Source that shows pictures drawn by a connected program for the requested eye positions."""

    def __init__(self, server: Server, *, display_m: tuple[float, float], background: Any) -> None:
        """Create a source that gives the server back when it is closed."""
        self._server, self._display_m = server, display_m
        self._shown: dict[int, ProgramPicture] = {}  # latest pictures, keyed by side
        self.info = ContentInfo("program", moving=True, background=background, fixed_views=True)
        self._expected: tuple[int, list[View]] | None = None  # number and views of the requested frame
        self._released = weakref.finalize(self, release, server)

    @property
    def program(self) -> dict[str, Any]:
        return {"address": self._server.address, "frame_ms": self._server.frame_ms}

    @property
    def problem(self) -> str:
        return self._server.problem

    def expect(self, views: Sequence[View], *, time_ns: int) -> None:
        self._expected = None
        width_px, height_px = views[0].width_px, views[0].height_px
        asked = AskedViews(time_ns, width_px, height_px, tuple(map(camera_of, views)), self._display_m)
        self._expected = self._server.ask(asked), list(views)

    def render(self, view: View, *, time_ns: int) -> U8:
        if self._expected is None or not any(_same(view, one) for one in self._expected[1]):
            self.expect([view], time_ns=time_ns)
        assert self._expected is not None
        try:
            picture = self._shown[view.side] = self._server.drawn(self._expected[0]).pictures[view.side]
        except ContentFailure:
            self._expected = None  # ask again
            raise
        if picture.pixels.shape[:2] == (view.height_px, view.width_px):
            return np.ascontiguousarray(picture.pixels)
        return np.asarray(cv2.resize(picture.pixels, (view.width_px, view.height_px)), np.uint8)

    def nearness(self, view: View, *, every: int, first: tuple[int, int]) -> F32 | None:
        picture = self._shown.get(view.side)
        if picture is None or picture.depth is None:
            return None
        depth: NDArray[Any] = picture.depth
        if depth.shape != (view.height_px, view.width_px):
            depth = np.asarray(cv2.resize(depth, (view.width_px, view.height_px), interpolation=cv2.INTER_NEAREST))
        return nearness_of(depth, every=every, first=first)

    def close(self) -> None:
        self._shown.clear()
        self._released()


def nearness_of(depth: NDArray[Any], *, every: int, first: tuple[int, int]) -> F32:
    """Return the inverse distance to the nearest point in each block of a depth picture, in 1/m, as
    `nearness` does. `depth` are (h, w) values of a depth buffer drawn with `camera_of`'s projection: 0-1, or 0-65535.
    """
    farthest = 65535 if depth.dtype == np.uint16 else 1
    rows, columns = (-(-(size + start) // every) for size, start in zip(depth.shape, first[::-1]))
    padded = np.full((rows * every, columns * every), farthest, depth.dtype)
    padded[first[1] : first[1] + depth.shape[0], first[0] : first[0] + depth.shape[1]] = depth
    lines = padded.reshape(rows, every, columns * every).min(1)
    nearest = lines.reshape(rows, columns, every).min(2).astype(np.float32) / np.float32(farthest)
    # Between the near and far planes, depth is linear in the inverse distance.
    inverse = np.float32(1 / NEAR_M) - nearest * np.float32(1 / NEAR_M - 1 / FAR_M)
    return np.where((nearest >= 0) & (nearest < 1), inverse, np.float32(0))


def _same(view: View, other: View) -> bool:
    matrices = view.pixels_from_stack, other.pixels_from_stack
    return view.side == other.side and np.array_equal(*matrices) and view.width_px == other.width_px
